// The one translation unit of the core: setup.py compiles it once per kind of processor. Everything else is headers.
#include "interface.h"
#include "target.h"

int pbfd_interface() { return 1; }

int pbfd_lanes(int bytes) { return pbfd::register_bytes / bytes; }

const char* pbfd_target() { return pbfd::target; }
