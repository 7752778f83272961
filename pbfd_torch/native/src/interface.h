// What the library offers to Python: plain C functions, called by ctypes (pbfd_torch/native/library.py).
#pragma once

#define PBFD_FUNCTION extern "C" __attribute__((visibility("default")))

// The version of this interface. A change of it here is a change of INTERFACE in library.py.
PBFD_FUNCTION int pbfd_interface();

// How many worlds one register holds, for scalars of 8 or 4 bytes.
PBFD_FUNCTION int pbfd_lanes(int bytes);

// The kind of processor that the library is compiled for: "x86-64-v4", ...
PBFD_FUNCTION const char* pbfd_target();
