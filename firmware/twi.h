// The I2C slave's hardware (TWI, datasheet 20). The protocol is in slave.h.
#pragma once

namespace twi {

void start();
void tick();  // once a millisecond, in the timer's interrupt

}  // namespace twi
