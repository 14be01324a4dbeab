#include "location.h"

#include <string.h>

namespace {

constexpr uint8_t HEAD_SIZE = 5;
constexpr uint8_t HEAD[HEAD_SIZE] = {0x40, 0x01, 0x00, 0x41, 0x0D};
constexpr uint8_t LAST_ERROR = 5;
constexpr uint16_t RECORDS = 21;  // offset of the first range

}  // namespace

// Whether the byte at `at` may stand there, given that all before it may.
LocationReader::Verdict LocationReader::check(uint16_t at) const
{
    const uint8_t byte = bytes_[at];
    if (at == 2 && byte != 0)
        return byte <= LAST_ERROR ? refused : wrong;
    if (at < HEAD_SIZE)
        return byte == HEAD[at] ? fits : wrong;
    if (at >= 2 * HEAD_SIZE - 1 && byte == HEAD[HEAD_SIZE - 1] &&
        memcmp(bytes_ + at + 1 - HEAD_SIZE, HEAD, HEAD_SIZE) == 0)
        return new_head;
    switch (at) {
    case 17:
        return byte <= 100 ? fits : wrong;
    case 18:
        return byte == 0x49 ? fits : wrong;
    case 19:
        return byte % 20 == 1 && byte <= 1 + 20 * MOST_RANGES ? fits : wrong;
    case 20:
        if (bytes_[19] != 1 + 20 * byte)
            return wrong;
        return byte == 0 ? complete : fits;
    }
    if (at < RECORDS)
        return fits;
    const uint8_t in_record = static_cast<uint8_t>((at - RECORDS) % 20);
    if ((in_record == 6 || in_record == 19) && byte > 100)
        return wrong;
    return at == RECORDS + 20 * bytes_[20] - 1 ? complete : fits;
}

void LocationReader::drop(uint16_t count)
{
    length_ = static_cast<uint16_t>(length_ - count);
    memmove(bytes_, bytes_ + count, length_);
}

LocationReader::Result LocationReader::feed(uint8_t byte)
{
    bytes_[length_++] = byte;
    uint16_t at = static_cast<uint16_t>(length_ - 1);
    while (at < length_) {
        switch (check(at)) {
        case fits:
            ++at;
            break;
        case complete:
            length_ = 0;
            return location;
        case refused:
            length_ = 0;
            return refusal;
        case new_head:
            drop(static_cast<uint16_t>(at + 1 - HEAD_SIZE));
            at = HEAD_SIZE;
            break;
        case wrong: {
            const void* next = memchr(bytes_ + 1, HEAD[0], length_ - 1);
            drop(next != nullptr ? static_cast<uint16_t>(static_cast<const uint8_t*>(next) - bytes_) : length_);
            at = 0;
            break;
        }
        }
    }
    return more;
}

void LocationReader::reset()
{
    length_ = 0;
}
