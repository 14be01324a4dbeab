// Wheel encoders, counted by interrupts into front.encoders.
#pragma once

namespace encoders {

void start();

}  // namespace encoders
