#include "panel.h"

#include <avr/io.h>
#include <util/delay.h>

#include "front.h"

namespace panel {

namespace {

// Yellow LED: PC7, on when high. Green LED and button B: PD5. Red LED and button C: PB0. Both LEDs on when low.
// Button A: PB3. Buttons pull low. All are single-bit instructions, which no interrupt can tear.

uint8_t last = 0;

inline bool pressed(volatile uint8_t& pin, volatile uint8_t& direction, volatile uint8_t& port, uint8_t bit)
{
    direction &= static_cast<uint8_t>(~bit);
    port |= bit;
    _delay_us(3);  // the pull-up loads the line
    const bool low = (pin & bit) == 0;
    return low;
}

inline void light(bool on_when_low, bool on, volatile uint8_t& direction, volatile uint8_t& port, uint8_t bit)
{
    if (on != on_when_low)
        port |= bit;
    else
        port &= static_cast<uint8_t>(~bit);
    direction |= bit;
}

}  // namespace

void start()
{
    PORTB |= _BV(PB3);
    show_leds();
}

void show_leds()
{
    light(true, front.leds[0] != 0, DDRB, PORTB, _BV(PB0));
    light(false, front.leds[1] != 0, DDRC, PORTC, _BV(PC7));
    light(true, front.leds[2] != 0, DDRD, PORTD, _BV(PD5));
}

void read_buttons()
{
    uint8_t now = 0;
    if ((PINB & _BV(PB3)) == 0)
        now |= 0x01;
    if (pressed(PIND, DDRD, PORTD, _BV(PD5)))
        now |= 0x02;
    if (pressed(PINB, DDRB, PORTB, _BV(PB0)))
        now |= 0x04;
    show_leds();
    const uint8_t steady = static_cast<uint8_t>(~(now ^ last));
    front.buttons = static_cast<uint8_t>((front.buttons & ~steady) | (now & steady));
    last = now;
}

}  // namespace panel
