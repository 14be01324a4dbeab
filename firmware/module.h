// The conversation with the DWM1001: ten times a second a loc_get, and in between what the Pi laid into the mailbox.
#pragma once

#include <stdint.h>

namespace module {

void start();
void run(uint32_t now);  // main loop, at least once a millisecond

}  // namespace module
