#include "buzzer.h"

#include <avr/io.h>
#include <util/atomic.h>

#include "front.h"
#include "tune.h"

namespace buzzer {

namespace {

Tune tune;

// Timer 4 has registers of 10 bits: the upper two go through TC4H first (datasheet 15, Accessing 10-bit Registers).
void write10(volatile uint8_t& low, uint16_t value)
{
    TC4H = static_cast<uint8_t>(value >> 8);
    low = static_cast<uint8_t>(value);
}

void sound(const Tone& tone, uint8_t volume)
{
    TCCR4B = 0;
    if (tone.top == 0 || volume == 0) {
        TCCR4C = 0;  // OC4D lets go of the pin, which is low
        return;
    }
    write10(OCR4C, tone.top);
    write10(OCR4D, compare_of(tone.top, volume));
    write10(TCNT4L, 0);
    TCCR4C = _BV(COM4D1) | _BV(PWM4D);
    TCCR4B = tone.prescaler;
}

}  // namespace

void start()
{
    PORTD &= static_cast<uint8_t>(~_BV(PD7));
    DDRD |= _BV(PD7);  // OC4D
    TCCR4A = 0;
    TCCR4B = 0;
    TCCR4C = 0;
    TCCR4D = _BV(WGM40);  // phase and frequency correct, top in OCR4C (datasheet 15, TCCR4D)
    TCCR4E = 0;
}

bool play(const uint8_t* bytes, uint8_t count)
{
    if (!tune.load(bytes, count))
        return false;
    front.notes_left = tune.left();
    return true;
}

void tick()
{
    bool changed;
    uint8_t pitch;
    uint8_t volume;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        changed = tune.tick();
        pitch = tune.pitch();
        volume = tune.volume();
        front.notes_left = tune.left();
    }
    if (changed)
        sound(tone_of(pitch), volume);
}

}  // namespace buzzer
