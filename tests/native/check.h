// CHECK(condition) counts what does not hold and says where; a test ends with `return failures()`.
#pragma once
#include <cstdio>

inline int& failures() {
  static int count = 0;
  return count;
}

#define CHECK(condition) \
  if (!(condition)) std::fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition), ++failures()
