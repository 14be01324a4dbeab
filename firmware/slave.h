// The I2C protocol without the I2C hardware: what each event on the bus means. Called with interrupts off.
//
// Rules. The first byte of a write is the index; at that moment the values are frozen, so that a read of several bytes
// belongs to one moment, also when it is made in several transfers without a new index. The UWB report alone stays the
// one that its own index froze. Data bytes are held and applied
// together at STOP, or not at all: a byte that fits nowhere is not acknowledged and the whole write is forgotten.
#pragma once

#include <stdint.h>

namespace slave {

void started();                // addressed, the master will write
bool copies(uint8_t byte);     // it is an index at which 16 bytes or more are copied
bool received(uint8_t byte);   // returns whether the next byte may be acknowledged
void stopped();                // STOP or repeated START: apply what was held
void refused();                // a byte was not acknowledged: forget what was held
void abandoned();              // the transfer ended in the middle: the same, but not the master's mistake
uint8_t transmit();            // the next byte of a read

}  // namespace slave
