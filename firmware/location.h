// Reads the answer of a DWM1001 tag to loc_get out of a stream of bytes, among any noise (API guide, dwm_loc_get).
//
//     40 01 err | 41 0D  place (13)  | 49 LEN  count  (address 2, distance 4, quality 1, place 13) x count
//
// The protocol has neither frame mark nor checksum, so everything that must hold is checked at the byte where it must:
// types, lengths, count against length, percentages. At the first contradiction reading goes on at the next byte that
// can begin an answer, and also when a whole head appears inside of one: then the first was cut off.
#pragma once

#include <stdint.h>

class LocationReader {
public:
    static constexpr uint8_t MOST_RANGES = 12;  // the length of a part is at most 253: 1 + 20 x 12 = 241
    static constexpr uint16_t LONGEST = 3 + 15 + 2 + 1 + 20 * MOST_RANGES;

    enum Result : uint8_t { more, location, refusal };

    Result feed(uint8_t byte);
    void reset();

    bool begun() const { return length_ != 0; }

    // Of the last location, until the next byte is fed.
    uint8_t count() const { return bytes_[20]; }
    const uint8_t* place() const { return bytes_ + 5; }
    const uint8_t* range(uint8_t n) const { return bytes_ + 21 + 20 * n; }

    // Of the last refusal.
    uint8_t error() const { return bytes_[2]; }

private:
    enum Verdict : uint8_t { fits, wrong, new_head, complete, refused };

    Verdict check(uint16_t at) const;
    void drop(uint16_t count);

    uint8_t bytes_[LONGEST];
    uint16_t length_ = 0;
};
