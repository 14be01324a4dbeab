// Whether bytes are a whole answer of the DWM1001 to whatever was asked (API guide, TLV format): status, whole parts.
#pragma once

#include <stdint.h>

namespace tlv {

bool whole(const uint8_t* bytes, uint16_t count);

}  // namespace tlv
