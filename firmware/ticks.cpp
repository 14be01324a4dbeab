#include "ticks.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "boot.h"
#include "encoders.h"
#include "motors.h"
#include "twi.h"

namespace ticks {

namespace {

// A round of the main loop takes less than a millisecond; reading a long frame out of noise may take some.
constexpr uint8_t LOOP_PATIENCE_MS = 100;

volatile uint32_t milliseconds = 0;
volatile uint8_t loop_left = LOOP_PATIENCE_MS;

}  // namespace

void start()
{
    // Datasheet 13, Clear Timer on Compare Match Mode: 16 MHz / 64 / 250 = 1 kHz.
    TCCR0A = _BV(WGM01);
    OCR0A = 249;
    TIMSK0 = _BV(OCIE0A);
    TCCR0B = _BV(CS01) | _BV(CS00);
}

uint32_t now()
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        return milliseconds;
    }
    __builtin_unreachable();
}

uint32_t now_in_interrupt()
{
    return milliseconds;
}

bool loop_alive()
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        if (loop_left == 0)
            return false;
        loop_left = LOOP_PATIENCE_MS;
    }
    return true;
}

}  // namespace ticks

// Everything inlined: a call would make it save all registers, 3 us.
ISR(TIMER0_COMPA_vect, __attribute__((flatten)))
{
    ticks::milliseconds = ticks::milliseconds + 1;
    motors::tick();
    encoders::tick();
    twi::tick();
    if (ticks::loop_left != 0) {
        ticks::loop_left = static_cast<uint8_t>(ticks::loop_left - 1);
        if (ticks::loop_left == 0)
            boot::hung();  // motors off now; the watchdog, which nobody feeds from here on, resets the chip
    }
}
