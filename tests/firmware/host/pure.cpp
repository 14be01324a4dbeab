// The pure parts of the firmware as a library for tests on any machine, with stand-ins for the hardware behind them.
#include <stddef.h>

#include "boot.h"
#include "buzzer.h"
#include "front.h"
#include "location.h"
#include "mailbox.h"
#include "motors.h"
#include "quadrature.h"
#include "reports.h"
#include "slave.h"
#include "ticks.h"
#include "tlv.h"
#include "tune.h"

namespace {

uint32_t time_ms = 0;
uint32_t motor_writes = 0;
uint16_t last_command = 0;
Tune tune;
LocationReader reader;

}  // namespace

namespace ticks {
uint32_t now_in_interrupt() { return time_ms; }
}  // namespace ticks

namespace motors {
void written() { ++motor_writes; }
}  // namespace motors

namespace boot {
bool command(uint16_t value)
{
    last_command = value;
    return value == layout::BOOTLOADER_COMMAND;
}
}  // namespace boot

namespace buzzer {
bool play(const uint8_t* bytes, uint8_t count) { return tune.load(bytes, count); }
}  // namespace buzzer

extern "C" {

void pure_time(uint32_t ms) { time_ms = ms; }
uint8_t pure_front(uint8_t at) { return reinterpret_cast<const volatile uint8_t*>(&front)[at]; }
void pure_set_front(uint8_t at, uint8_t value) { reinterpret_cast<volatile uint8_t*>(&front)[at] = value; }
uint32_t pure_motor_writes() { return motor_writes; }
uint16_t pure_last_command() { return last_command; }

void slave_started() { slave::started(); }
bool slave_received(uint8_t byte) { return slave::received(byte); }
void slave_stopped() { slave::stopped(); }
void slave_refused() { slave::refused(); }
uint8_t slave_transmit() { return slave::transmit(); }

void report_fill(uint8_t value)
{
    layout::UwbReport& report = reports::next();
    report.count = value;
    for (uint8_t& byte : report.place)
        byte = value;
    for (auto& range : report.ranges)
        for (uint8_t& byte : range)
            byte = value;
    for (auto& place : report.places)
        for (uint8_t& byte : place)
            byte = value;
}
void report_publish(uint32_t now) { reports::publish(now); }

uint8_t mailbox_byte(uint16_t at) { return mailbox::bytes[at]; }
uint16_t mailbox_request() { return mailbox::request_length(); }

// Returns 0, 1 for a location, 2 for a refusal.
uint8_t location_feed(uint8_t byte) { return reader.feed(byte); }
void location_reset() { reader.reset(); }
bool location_begun() { return reader.begun(); }
uint8_t location_error() { return reader.error(); }
// place, then ranges; returns their number
uint8_t location_copy(uint8_t* to)
{
    for (uint8_t i = 0; i < 13; ++i)
        *to++ = reader.place()[i];
    for (uint16_t i = 0; i < 20 * reader.count(); ++i)
        *to++ = reader.range(0)[i];
    return reader.count();
}

bool tlv_whole(const uint8_t* bytes, uint16_t count) { return tlv::whole(bytes, count); }

uint16_t tone_top(uint8_t pitch) { return tone_of(pitch).top; }
uint8_t tone_prescaler(uint8_t pitch) { return tone_of(pitch).prescaler; }
uint16_t tone_compare(uint16_t top, uint8_t volume) { return compare_of(top, volume); }
bool tune_tick() { return tune.tick(); }
uint8_t tune_pitch() { return tune.pitch(); }
uint8_t tune_left() { return tune.left(); }

// bits of `signals`, a pair each: XOR, then B. Returns the count, errors in *lost.
int32_t quadrature_count(const uint8_t* signals, size_t pairs, uint32_t* lost)
{
    Quadrature wheel;
    int32_t count = 0;
    for (size_t i = 0; i < pairs; ++i) {
        bool missed;
        count += wheel.step(signals[2 * i] != 0, signals[2 * i + 1] != 0, missed);
        *lost += missed ? 1 : 0;
    }
    return count;
}

}
