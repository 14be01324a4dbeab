// Wheel encoders, counted by interrupts into front.encoders.
#pragma once

namespace encoders {

void start();
void tick();  // once a millisecond, in the timer's interrupt

}  // namespace encoders
