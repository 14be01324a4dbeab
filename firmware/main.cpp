// Firmware of the Balboa 32U4's ATmega32U4: the robot's body on one I2C address, for a Raspberry Pi that thinks.
//
// What must be exact is done by interrupts (I2C, encoders, serial line, the millisecond and with it the motors'
// watchdog). The main loop does the rest in rounds of less than a millisecond and sleeps in between.

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "battery.h"
#include "boot.h"
#include "buzzer.h"
#include "encoders.h"
#include "front.h"
#include "module.h"
#include "motors.h"
#include "panel.h"
#include "ticks.h"
#include "twi.h"

namespace {

// The bootloader may leave USB switched on and its interrupts enabled (datasheet 21); nobody here serves them.
void usb_off()
{
    UDIEN = 0;
    USBCON = _BV(FRZCLK);
    UHWCON = 0;
    PLLCSR = 0;
}

void every_10_ms()
{
    panel::read_buttons();
    battery::sample();
}

void every_100_ms()
{
    boot::measure_stack();
}

}  // namespace

int main()
{
    usb_off();
    motors::start();
    front.version = layout::LAYOUT_VERSION;
    front.revision = layout::REVISION_NUMBER;
    boot::report_reset();
    boot::measure_stack();
    panel::start();
    battery::start();
    buzzer::start();
    encoders::start();
    module::start();
    ticks::start();
    twi::start();
    PRR0 = _BV(PRSPI);
    PRR1 = _BV(PRUSB) | _BV(PRTIM3);
    set_sleep_mode(SLEEP_MODE_IDLE);
    wdt_enable(WDTO_250MS);
    sei();

    uint32_t last = 0;
    uint8_t tens = 0;
    uint8_t hundreds = 0;
    for (;;) {
        const uint32_t now = ticks::now();
        module::run(now);
        if (now != last) {
            last = now;
            // A loop that comes back after its motors were locked is reset like one that does not: only a reset unlocks
            // them, and tells why.
            if (ticks::loop_alive())
                wdt_reset();
            boot::obey();
            panel::show_leds();
            buzzer::tick();
            if (++tens >= 10) {
                tens = 0;
                every_10_ms();
                if (++hundreds >= 10) {
                    hundreds = 0;
                    every_100_ms();
                }
            }
        }
        // Idle keeps all of the peripherals running. What came since the checks above is seen at the next
        // millisecond at the latest.
        sleep_mode();
    }
}
