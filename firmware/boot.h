// Beginnings and ends: why the chip was reset, how deep the stack ever was, and the way into the bootloader.
#pragma once

#include <stdint.h>

namespace boot {

void report_reset();            // main, once: fills front.reset_cause
void measure_stack();           // main loop, now and then: fills front.free_stack
bool command(uint16_t value);   // with interrupts off; false: no such command
void obey();                    // main loop: carry out a command; does not return if there was one
void hung();                    // timer interrupt: the main loop stands still

}  // namespace boot
