// Counts of one wheel from its two signals. The board gives XOR of both channels and channel B; A is XOR ^ B.
#pragma once

#include <stdint.h>

struct Quadrature {
    bool a = false;
    bool b = false;

    // -1, 0 or 1 count; forward is positive (B leads A). `lost` is set where both channels changed: one edge was missed
    // and the direction is unknown.
    int8_t step(bool x, bool new_b, bool& lost)
    {
        const bool new_a = x != new_b;
        lost = a != new_a && b != new_b;
        const int8_t change = static_cast<int8_t>((a != new_b) - (new_a != b));
        a = new_a;
        b = new_b;
        return change;
    }
};
