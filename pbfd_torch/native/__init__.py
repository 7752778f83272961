"""The compiled core: C++ in `src/`, its variants for kinds of processors in `lib/`, and how Python finds and loads one."""
