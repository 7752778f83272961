// The kind of processor that this translation unit is compiled for, and how wide its registers are.
#pragma once

namespace pbfd {

#if defined(__AVX512F__) && defined(__AVX512VL__)
inline constexpr const char* target = "x86-64-v4";
inline constexpr int register_bytes = 64;
#elif defined(__AVX2__) && defined(__FMA__)
inline constexpr const char* target = "x86-64-v3";
inline constexpr int register_bytes = 32;
#elif defined(__SSE4_2__)
inline constexpr const char* target = "x86-64-v2";
inline constexpr int register_bytes = 16;
#elif defined(__aarch64__)
inline constexpr const char* target = "arm64";
inline constexpr int register_bytes = 16;
#else
#error "the core is made for x86-64-v2 and better, and for arm64"
#endif

}  // namespace pbfd
