// LEDs and buttons. Buttons B and C share a pin with the green and the red LED.
#pragma once

namespace panel {

void start();
void show_leds();
void read_buttons();  // every 10 ms: two readings in a row must agree

}  // namespace panel
