#include "tune.h"

#include <string.h>

namespace {

constexpr uint8_t LOWEST = 12;    // C0
constexpr uint8_t HIGHEST = 119;  // B8

// Timer 4 counts up to its top and back (phase and frequency correct): f = 16 MHz / (2 x prescaler x top), datasheet
// 15.8. These are the tops of octave 8 (C8 4186 Hz to B8 7902 Hz) at prescaler 2; each octave below doubles it.
constexpr uint16_t TOPS[12] = {956, 902, 851, 804, 758, 716, 676, 638, 602, 568, 536, 506};

}  // namespace

Tone tone_of(uint8_t pitch)
{
    if (pitch < LOWEST || pitch > HIGHEST)
        return {0, 0};
    const uint8_t octave = static_cast<uint8_t>(pitch / 12 - 1);
    return {TOPS[pitch % 12], static_cast<uint8_t>(10 - octave)};
}

uint16_t compare_of(uint16_t top, uint8_t volume)
{
    return volume == 0 ? 0 : static_cast<uint16_t>(top >> (volume > 15 ? 1 : 16 - volume));
}

bool Tune::load(const uint8_t* bytes, uint8_t count)
{
    if (count == 0 || count % 2 == 0)
        return false;
    volume_ = bytes[0];
    count_ = static_cast<uint8_t>((count - 1) / 2);
    memcpy(notes_, bytes + 1, count - 1u);
    at_ = 0;
    remaining_ = 0;
    changed_ = playing_;
    playing_ = false;
    return true;
}

bool Tune::tick()
{
    if (remaining_ != 0 && --remaining_ != 0)
        return false;
    bool changed = changed_ || playing_;
    changed_ = playing_ = false;
    while (at_ < count_ && !playing_) {
        remaining_ = static_cast<uint16_t>(notes_[2 * at_ + 1] * 10);
        playing_ = remaining_ != 0;
        ++at_;
    }
    return changed || playing_;
}
