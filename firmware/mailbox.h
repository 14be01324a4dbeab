// A box in which the Pi lays any request to the DWM1001 and finds its answer. It is larger than what I2C carries at
// once, so it is seen through a window of 28 bytes, page by page. Called by the I2C interrupt, but for the last two.
#pragma once

#include "layout.h"

namespace mailbox {

constexpr uint16_t PAGES = 10;
constexpr uint16_t SIZE = PAGES * layout::WINDOW_SIZE;
// The longest request has 2 + 253 bytes, the longest known answer 3 + 15 + 2 + 241 (loc_get with twelve modules).
static_assert(SIZE >= 3 + 15 + 2 + 241, "too small for a loc_get");

bool write(uint8_t offset, const uint8_t* data, uint8_t count);  // from MAILBOX_PAGE; false: no such page
uint8_t read(uint8_t offset);
bool go(uint8_t token, uint8_t length);                          // false: nothing to send

extern uint8_t bytes[SIZE];   // the request; then, from the first byte received, the answer
uint16_t request_length();

}  // namespace mailbox
