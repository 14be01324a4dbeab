#include "encoders.h"

#include <avr/interrupt.h>
#include <avr/io.h>

#include "front.h"
#include "quadrature.h"

namespace encoders {

namespace {

// Left: XOR on PB4 = PCINT4, B on PE2. Right: XOR on PE6 = INT6, B on PF0. An edge of either channel is an edge of XOR.
Quadrature left, right;

// Edges of one wheel that are followed in a millisecond: six times what the robot's wheels make. A broken encoder may
// make so many that their interrupts, which go first, would leave no time for the clock that stops the motors.
constexpr uint8_t MOST_EDGES = 40;
volatile uint8_t left_edges = MOST_EDGES;
volatile uint8_t right_edges = MOST_EDGES;

inline bool used_up(volatile uint8_t& edges)
{
    const uint8_t more = static_cast<uint8_t>(edges - 1);
    edges = more;
    return more == 0;
}

inline bool left_x() { return PINB & _BV(PB4); }
inline bool left_b() { return PINE & _BV(PE2); }
inline bool right_x() { return PINE & _BV(PE6); }
inline bool right_b() { return PINF & _BV(PF0); }

inline void count(Quadrature& wheel, uint8_t side, bool x, bool b)
{
    bool lost;
    front.encoders[side] = static_cast<int16_t>(static_cast<uint16_t>(front.encoders[side]) + wheel.step(x, b, lost));
    if (lost)
        front.encoder_errors[side] = static_cast<uint8_t>(front.encoder_errors[side] + 1);
}

}  // namespace

void start()
{
    PORTB |= _BV(PB4);
    PORTE |= _BV(PE2) | _BV(PE6);
    PORTF |= _BV(PF0);
    left.b = left_b();
    left.a = left_x() != left.b;
    right.b = right_b();
    right.a = right_x() != right.b;
    PCMSK0 = _BV(PCINT4);      // datasheet 11
    PCIFR = _BV(PCIF0);
    EICRB = _BV(ISC60);        // any edge of INT6
    EIFR = _BV(INTF6);
    tick();
}

void tick()
{
    left_edges = MOST_EDGES;
    right_edges = MOST_EDGES;
    PCICR = _BV(PCIE0);
    EIMSK = _BV(INT6);
}

}  // namespace encoders

ISR(PCINT0_vect, __attribute__((flatten)))
{
    using namespace encoders;
    count(left, 0, left_x(), left_b());
    if (used_up(left_edges))
        PCICR = 0;
}

ISR(INT6_vect, __attribute__((flatten)))
{
    using namespace encoders;
    count(right, 1, right_x(), right_b());
    if (used_up(right_edges))
        EIMSK = 0;
}
