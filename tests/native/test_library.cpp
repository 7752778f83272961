// What the library says of itself.
#include "library.cpp"

#include <cstring>

#include "check.h"

int main() {
  CHECK(pbfd_interface() > 0);
  const bool narrow = !std::strcmp(pbfd_target(), "x86-64-v2") || !std::strcmp(pbfd_target(), "arm64");
  const int doubles = narrow ? 2 : !std::strcmp(pbfd_target(), "x86-64-v3") ? 4 : 8;
  CHECK(pbfd_lanes(8) == doubles);
  CHECK(pbfd_lanes(4) == 2 * doubles);
  return failures();
}
