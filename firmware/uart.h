// USART1, the line to the DWM1001, with interrupts in both directions: nobody ever waits for it.
#pragma once

#include <stdint.h>

namespace uart {

void start();
void send(const uint8_t* bytes, uint16_t count);  // they must stay until `sending` is false
bool sending();
bool take(uint8_t& byte);  // the next byte received; false: none
bool damaged();            // whether bytes were lost or garbled since the last call

}  // namespace uart
