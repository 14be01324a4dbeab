// Notes: how pitch becomes a setting of timer 4, and which note sounds when. No hardware, no waiting.
//
// A tune is a volume (0-15, each step half as loud, 15 the loudest) and up to 15 pairs of pitch and duration: pitch as
// a MIDI note number (69 = A4 = 440 Hz, 12-119 sound, anything else is a rest), duration in 10 ms.
#pragma once

#include "layout.h"

struct Tone {
    uint16_t top;      // 0 = silence; else the timer's top
    uint8_t prescaler;  // CS43:40
};

Tone tone_of(uint8_t pitch);
uint16_t compare_of(uint16_t top, uint8_t volume);

class Tune {
public:
    // False for what is no tune. A tune of no notes ends the one that plays.
    bool load(const uint8_t* bytes, uint8_t count);

    // Once a millisecond; true when another note (or silence) begins.
    bool tick();

    uint8_t pitch() const { return playing_ ? notes_[2 * (at_ - 1)] : 0; }
    uint8_t volume() const { return volume_; }
    uint8_t left() const { return static_cast<uint8_t>(count_ - at_ + (playing_ ? 1 : 0)); }

private:
    uint8_t notes_[2 * layout::TUNE_NOTES];
    uint8_t volume_ = 0;
    uint8_t count_ = 0;
    uint8_t at_ = 0;          // next note
    uint16_t remaining_ = 0;  // ms of the present one
    bool playing_ = false;
    bool changed_ = false;
};
