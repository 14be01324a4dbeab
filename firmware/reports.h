// The newest UWB report, handed from the main loop to the I2C interrupt without a lock.
//
// Three buffers: the newest report, the one the master has frozen by its index byte, and one to write the next into.
// They are told apart by two indices of one byte each, so neither side ever waits and no report is torn.
#pragma once

#include "layout.h"

namespace reports {

layout::UwbReport& next();      // main loop: to be filled, all but the sequence numbers and the age
void publish(uint32_t now);     // main loop: it is whole, and came now (ms)

void freeze(uint32_t now);      // interrupt
uint8_t number();               // interrupt: low byte of the newest report's sequence number
uint8_t frozen(uint8_t offset);  // interrupt: byte of the frozen report

}  // namespace reports
