// Motors: DRV8838 drivers with PWM on timer 1 and a direction pin each. Off unless the Pi goes on saying otherwise.
#pragma once

namespace motors {

void start();
void written();  // with interrupts off: the Pi wrote front.motors
void lock();     // with interrupts off: off until the next reset, whatever the Pi says
void tick();     // once a millisecond, in the timer's interrupt

}  // namespace motors
