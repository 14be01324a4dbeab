#include "battery.h"

#include <avr/io.h>
#include <util/atomic.h>

#include "front.h"

namespace battery {

namespace {

// The motors' PWM ripples on the supply: a running mean over 16 samples (160 ms).
uint16_t sum = 0;

}  // namespace

void start()
{
    DIDR0 = _BV(ADC6D);
    ADMUX = _BV(REFS0) | 6;  // against AVcc = 5 V; PF6 (datasheet 24, ADMUX)
    ADCSRA = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0) | _BV(ADSC);  // 125 kHz
}

void sample()
{
    if (ADCSRA & _BV(ADSC))
        return;
    const uint16_t raw = ADC;
    ADCSRA |= _BV(ADSC);
    sum = sum == 0 ? static_cast<uint16_t>(16 * raw) : static_cast<uint16_t>(sum - (sum + 8) / 16 + raw);
    // One third of the voltage, 5000 mV / 1024 a step: 1875 / 128 mV; the sum counts sixteenfold, and the converter
    // rounds down, half a step on the average.
    const uint16_t millivolts = static_cast<uint16_t>((static_cast<uint32_t>(sum) + 8) * 1875 / 2048);
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        front.battery = millivolts;
    }
}

}  // namespace battery
