// What kind of processor this is compiled for, and how wide its registers are.
#include "target.h"

#include <cstring>

#include "check.h"

int main() {
  const bool narrow = !std::strcmp(pbfd::target, "x86-64-v2") || !std::strcmp(pbfd::target, "arm64");
  const int doubles = narrow ? 2 : !std::strcmp(pbfd::target, "x86-64-v3") ? 4 : 8;
  CHECK(pbfd::register_bytes == 8 * doubles);
  return failures();
}
