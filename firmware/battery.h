// Battery voltage, from a third of it at ADC6.
#pragma once

namespace battery {

void start();
void sample();  // every 10 ms: take the last conversion, start the next

}  // namespace battery
