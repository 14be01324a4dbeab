#include "boot.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/wdt.h>
#include <util/atomic.h>

#include "front.h"
#include "motors.h"

extern uint8_t __heap_start;  // the linker's: first byte behind all variables

namespace boot {

namespace {

constexpr uint8_t PAINT = 0xC5;

// In RAM that neither reset nor start-up code clears. Power-up leaves chance in it, hence the long mark.
constexpr uint32_t MARK = 0xBA1B0A32;
uint32_t mark __attribute__((section(".noinit")));
uint8_t hung_before __attribute__((section(".noinit")));
uint8_t flags __attribute__((section(".noinit")));

volatile bool wanted = false;

// Pololu's bootloader (Caterina for the A-Star) stays after a watchdog reset if it finds this key here. Its address is
// fixed; `make size` and a test see to it that it lies above all variables.
constexpr uint16_t KEY = 0x7777;
constexpr uint16_t KEY_ADDRESS = 0x0800;

}  // namespace

// Nothing reads it here: `swarm flash` looks for it in the file, and refuses what is not for this chip or this layout.
struct Mark {
    char text[22];
    uint8_t signature[3];
    uint8_t layout;
    uint8_t revision;
};
static const Mark identity PROGMEM __attribute__((used)) = {
    "balboa-swarm firmware",
    {SIGNATURE_0, SIGNATURE_1, SIGNATURE_2},
    layout::LAYOUT_VERSION,
    layout::REVISION_NUMBER,
};

// Before variables are set up: no stack frame, only registers and .noinit.
extern "C" void boot_early() __attribute__((naked, used, section(".init3")));
extern "C" void boot_early()
{
    flags = MCUSR;
    MCUSR = 0;      // WDRF must be cleared before the watchdog can be switched off (datasheet 8, MCUSR)
    wdt_disable();  // after a watchdog reset it runs on, at its shortest
    for (uint8_t* p = &__heap_start; p <= reinterpret_cast<uint8_t*>(RAMEND); ++p)
        *p = PAINT;
}

void report_reset()
{
    uint8_t cause = flags & (layout::POWER_ON | layout::RESET_PIN | layout::BROWN_OUT | layout::WATCHDOG);
    if (mark == MARK && (cause & layout::POWER_ON) == 0) {
        cause |= layout::WARM;
        if (hung_before == 1)
            cause |= layout::HUNG;
    }
    mark = MARK;
    hung_before = 0;
    front.reset_cause = cause;
}

void measure_stack()
{
    const uint8_t* p = &__heap_start;
    while (p <= reinterpret_cast<uint8_t*>(RAMEND) && *p == PAINT)
        ++p;
    const uint16_t unused = static_cast<uint16_t>(p - &__heap_start);
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        front.free_stack = unused;
    }
}

bool command(uint16_t value)
{
    if (value != layout::BOOTLOADER_COMMAND)
        return false;
    wanted = true;
    return true;
}

void obey()
{
    if (!wanted)
        return;
    cli();
    motors::lock();
    *reinterpret_cast<volatile uint16_t*>(KEY_ADDRESS) = KEY;
    wdt_enable(WDTO_15MS);
    wdt_reset();  // the short time counts from here
    for (;;) {
    }
}

void hung()
{
    motors::lock();
    hung_before = 1;
}

}  // namespace boot

// An interrupt nobody asked for: something is badly wrong. Motors off; the watchdog resets the chip.
ISR(BADISR_vect)
{
    motors::lock();
    for (;;) {
    }
}
