// Time: timer 0 counts milliseconds, and what must not depend on the main loop hangs on its interrupt.
#pragma once

#include <stdint.h>

namespace ticks {

void start();
uint32_t now();               // ms, main loop
uint32_t now_in_interrupt();  // ms, with interrupts off
bool loop_alive();            // main loop: it still goes round; false for good after it stood still for too long

}  // namespace ticks
