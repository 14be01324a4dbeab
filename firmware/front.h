// The live values of offsets 0 to 31. Interrupts read and write it; the main loop writes numbers of more than one byte
// in an ATOMIC_BLOCK of a few cycles.
#pragma once

#include "layout.h"

extern volatile layout::Front front;
