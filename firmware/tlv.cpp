#include "tlv.h"

namespace tlv {

bool whole(const uint8_t* bytes, uint16_t count)
{
    if (count < 3 || bytes[0] != 0x40 || bytes[1] != 1)
        return false;
    uint16_t at = 3;
    while (at + 2u <= count)
        at = static_cast<uint16_t>(at + 2 + bytes[at + 1]);
    // A refusal (third byte not 0) has no parts.
    return at == count && (bytes[2] == 0 || count == 3);
}

}  // namespace tlv
