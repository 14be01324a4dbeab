// The buzzer on timer 4. It is set and left alone; nothing waits for it or is interrupted by it.
#pragma once

#include <stdint.h>

namespace buzzer {

void start();
bool play(const uint8_t* bytes, uint8_t count);  // with interrupts off; what tune.h says. False: no tune
void tick();                                     // main loop, once a millisecond

}  // namespace buzzer
