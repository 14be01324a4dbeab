#include "motors.h"

#include <avr/io.h>

#include "front.h"

namespace motors {

namespace {

using layout::MOTOR_TOP;

constexpr uint8_t LEFT_DIRECTION = _BV(PB2);
constexpr uint8_t RIGHT_DIRECTION = _BV(PB1);
constexpr uint8_t LEFT_PWM = _BV(PB6);   // OC1B
constexpr uint8_t RIGHT_PWM = _BV(PB5);  // OC1A

uint8_t left_ms = 0;  // until the motors are stopped; 0: they are not running
bool locked = false;

int16_t clamped(int16_t value)
{
    return value > MOTOR_TOP ? MOTOR_TOP : value < -MOTOR_TOP ? static_cast<int16_t>(-MOTOR_TOP) : value;
}

inline void off()
{
    OCR1A = 0;
    OCR1B = 0;
    front.motors[0] = 0;
    front.motors[1] = 0;
    left_ms = 0;
}

}  // namespace

void start()
{
    // Datasheet 14.8, Phase and Frequency Correct PWM Mode: mode 8, top in ICR1. 16 MHz / (2 x 400) = 20 kHz.
    // The comparators are zero before the pins become outputs. The mode comes before its top: in others the chip
    // ignores what is written to ICR1 (datasheet 14, Input Capture Unit), and with a top of 0 no duty is right.
    TCCR1B = 0;
    OCR1A = 0;
    OCR1B = 0;
    TCNT1 = 0;
    TCCR1A = _BV(COM1A1) | _BV(COM1B1);
    TCCR1B = _BV(WGM13);
    ICR1 = MOTOR_TOP;
    TCCR1B = _BV(WGM13) | _BV(CS10);
    PORTB &= static_cast<uint8_t>(~(LEFT_DIRECTION | RIGHT_DIRECTION | LEFT_PWM | RIGHT_PWM));
    DDRB |= LEFT_DIRECTION | RIGHT_DIRECTION | LEFT_PWM | RIGHT_PWM;
}

void written()
{
    if (locked) {
        off();
        return;
    }
    const int16_t left = clamped(front.motors[0]);
    const int16_t right = clamped(front.motors[1]);
    front.motors[0] = left;
    front.motors[1] = right;
    if (left < 0)
        PORTB |= LEFT_DIRECTION;
    else
        PORTB &= static_cast<uint8_t>(~LEFT_DIRECTION);
    if (right < 0)
        PORTB |= RIGHT_DIRECTION;
    else
        PORTB &= static_cast<uint8_t>(~RIGHT_DIRECTION);
    OCR1B = static_cast<uint16_t>(left < 0 ? -left : left);
    OCR1A = static_cast<uint16_t>(right < 0 ? -right : right);
    // The first tick comes after anything up to a millisecond: one more makes it 200 to 201 ms, never less.
    left_ms = left != 0 || right != 0 ? layout::MOTOR_TIMEOUT_MS + 1 : 0;
    front.status = static_cast<uint8_t>(front.status & ~layout::STOPPED_BY_WATCHDOG);
}

void lock()
{
    locked = true;
    off();
}

void tick()
{
    if (left_ms == 0 || --left_ms != 0)
        return;
    off();
    front.status = static_cast<uint8_t>(front.status | layout::STOPPED_BY_WATCHDOG);
}

}  // namespace motors
