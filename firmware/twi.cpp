#include "twi.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/delay.h>
#include <util/twi.h>

#include "front.h"
#include "slave.h"

#ifndef HOLD_US
#define HOLD_US 12
#endif

namespace twi {

namespace {

constexpr uint8_t GO_ON = _BV(TWEN) | _BV(TWIE) | _BV(TWINT);
constexpr uint8_t ACKNOWLEDGE = _BV(TWEA);

// SMBus gives up a transfer after 25 to 35 ms (its T_TIMEOUT); a Pi's kernel never pauses that long inside of one.
constexpr uint8_t PATIENCE_MS = 30;
volatile uint8_t patience = 0;  // 0: not in a transfer

// The I2C master of the Pi (BCM2835 and its kin) keeps its bit clock running while SCL is held, and may make a pulse
// too short to see if it is let go near a clock edge, half a clock period apart: 5 us at 100 kHz. Holding for two edges and
// more is safe. The interrupt's own 4 us come on top: 16 us are two edges at 62.5 kHz and one at 40 (README.md).
inline void hold()
{
    _delay_us(HOLD_US);
}

}  // namespace

void start()
{
    TWAR = layout::ADDRESS << 1;  // bit 0 clear: no general call
    TWAMR = 0;
    TWCR = GO_ON | ACKNOWLEDGE;
}

void tick()
{
    if (patience == 0)
        return;
    patience = static_cast<uint8_t>(patience - 1);
    if (patience != 0)
        return;
    // The master stopped clocking, or a lost clock pulse left this slave in the middle of a byte, perhaps holding SDA
    // low: switched off, the TWI lets go of both lines (datasheet 20, TWCR).
    TWCR = 0;
    slave::abandoned();
    front.bus_resets = static_cast<uint8_t>(front.bus_resets + 1);
    TWCR = GO_ON | ACKNOWLEDGE;
}

}  // namespace twi

// Status codes: datasheet tables 20-3 (slave receiver) and 20-4 (slave transmitter). SCL is held from the event until
// TWINT is written at the end.
ISR(TWI_vect)
{
    using namespace twi;
    uint8_t acknowledge = ACKNOWLEDGE;
    patience = 0;
    switch (TW_STATUS) {
    case TW_SR_SLA_ACK:
        patience = PATIENCE_MS;
        slave::started();
        hold();
        break;
    case TW_SR_DATA_ACK:
        patience = PATIENCE_MS;
        if (!slave::copies(TWDR))
            hold();  // copying takes its time as it is
        if (!slave::received(TWDR))
            acknowledge = 0;
        break;
    case TW_SR_DATA_NACK:
        // Not addressed any more: no STOP will be reported.
        slave::refused();
        hold();
        break;
    case TW_SR_STOP:
        slave::stopped();
        break;
    case TW_ST_SLA_ACK:
    case TW_ST_DATA_ACK:
        patience = PATIENCE_MS;
        TWDR = slave::transmit();
        hold();
        break;
    case TW_BUS_ERROR:
        slave::abandoned();
        acknowledge |= _BV(TWSTO);  // lets go of the lines, no STOP is sent (datasheet 20, Miscellaneous States)
        break;
    default:  // the master has read enough
        hold();
        break;
    }
    TWCR = static_cast<uint8_t>(GO_ON | acknowledge);
}
