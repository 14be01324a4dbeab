// What the Pi finds at I2C slave 20: every offset, once. services/balancer/core/devices/balboa.py has the same numbers and a
// test compares them, so this table is written to be read by a machine too: one FIELD a line.
//
// A write is an index byte and data from that index on; a read is a write of the index byte alone, STOP, a pause of
// 100 us, and the bytes. Numbers are little-endian. README.md tells what each field means.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace layout {

constexpr uint8_t ADDRESS = 20;
constexpr uint8_t LAYOUT_VERSION = 2;  // another one means: offsets moved. New fields in reserved places keep it.
constexpr uint8_t REVISION_NUMBER = 2;  // counts releases of the firmware

constexpr uint8_t UWB_RANGES = 4;  // a PANS tag ranges to four modules at a time (DWM1001 system overview)
constexpr uint8_t UWB_PLACE_SIZE = 13;
constexpr uint8_t UWB_RANGE_SIZE = 7;
constexpr uint8_t TUNE_NOTES = 15;
constexpr uint8_t WINDOW_SIZE = 28;

//    FIELD(name, offset, size, who writes it)
#define LAYOUT_FIELDS(FIELD)                                                                              \
    FIELD(VERSION, 0, 1, firmware)           /* LAYOUT_VERSION */                                         \
    FIELD(LEDS, 1, 3, pi)                    /* red, yellow, green: 0 off, else on */                     \
    FIELD(MOTORS, 4, 4, pi)                  /* int16 left, right: -400..400 = duty -1..1 */              \
    FIELD(ENCODERS, 8, 4, firmware)          /* int16 left, right: counts, wrapping */                    \
    FIELD(BUTTONS, 12, 1, firmware)          /* bit 0 A, 1 B, 2 C: pressed */                             \
    FIELD(STATUS, 13, 1, firmware)           /* bit 0: motors stopped, no motor write came in time; */    \
                                             /* bits 4-7: number of the newest UWB report, modulo 16 */   \
    FIELD(BATTERY, 14, 2, firmware)          /* uint16 mV */                                              \
    FIELD(RESET_CAUSE, 16, 1, firmware)      /* bits of ResetCause */                                     \
    FIELD(REVISION, 17, 1, firmware)         /* REVISION_NUMBER */                                        \
    FIELD(FREE_STACK, 18, 2, firmware)       /* uint16: bytes the stack has never reached */              \
    FIELD(ENCODER_ERRORS, 20, 2, firmware)   /* uint8 left, right: both channels changed at once */       \
    FIELD(REFUSED, 22, 1, firmware)          /* uint8, wrapping: I2C writes refused */                    \
    FIELD(BUS_RESETS, 23, 1, firmware)       /* uint8, wrapping: I2C transfers abandoned by the Pi */     \
    FIELD(UWB_STATE, 24, 1, firmware)        /* UwbState of the last poll */                              \
    FIELD(UWB_ERROR, 25, 1, firmware)        /* error code of the module's last refusal */                \
    FIELD(UWB_BAD, 26, 1, firmware)          /* uint8, wrapping: polls whose answer was not whole */      \
    FIELD(NOTES_LEFT, 27, 1, firmware)       /* notes still to be played */                               \
    FIELD(MAILBOX_STATE, 28, 1, firmware)    /* MailboxState */                                           \
    FIELD(MAILBOX_ECHO, 29, 1, firmware)     /* token of the request the state is about */                \
    FIELD(MAILBOX_LENGTH, 30, 2, firmware)   /* uint16: bytes of the answer */                            \
    FIELD(UWB, 32, 100, firmware)            /* the last whole report, see UwbReport */                   \
    FIELD(COMMAND, 144, 2, pi)               /* uint16: BOOTLOADER_COMMAND; reads as 0 */                 \
    FIELD(NOTES, 160, 31, pi)                /* volume, then (pitch, duration) pairs; reads as 0 */       \
    FIELD(MAILBOX_TOKEN, 192, 1, pi)         /* written together with the next: send the request */       \
    FIELD(MAILBOX_REQUEST_LENGTH, 193, 1, pi)                                                             \
    FIELD(MAILBOX_PAGE, 194, 1, pi)          /* which 28 bytes of request or answer the window shows */   \
    FIELD(MAILBOX_WINDOW, 195, 28, pi)

#define LAYOUT_CONSTANT(name, offset, size, writer) constexpr uint8_t name = offset;
LAYOUT_FIELDS(LAYOUT_CONSTANT)
#undef LAYOUT_CONSTANT

// An index from JOINED on reads ENCODERS to STATUS, and goes on at four times what it is above JOINED: what changes in
// every tick and a piece of something else in one transfer. ONWARD goes on where the last such read ended.
constexpr uint8_t JOINED = 223;
constexpr uint8_t ONWARD = 255;

constexpr int16_t MOTOR_TOP = 400;
constexpr uint8_t MOTOR_TIMEOUT_MS = 200;

constexpr uint8_t STOPPED_BY_WATCHDOG = 0x01;

constexpr uint16_t BOOTLOADER_COMMAND = 0xB007;

enum ResetCause : uint8_t {
    POWER_ON = 0x01,     // these four as in MCUSR (ATmega32U4 datasheet 8)
    RESET_PIN = 0x02,
    BROWN_OUT = 0x04,
    WATCHDOG = 0x08,
    HUNG = 0x40,         // the main loop had stood still for 100 ms
    WARM = 0x80,         // RAM had kept its contents: a reset with the power on
};

enum class UwbState : uint8_t {
    silent = 0,   // no byte came
    ok = 1,
    refused = 2,  // the module answered with an error: UWB_ERROR
    broken = 3,   // bytes came, but no whole answer
    paused = 4,   // the mailbox has the line
};

enum class MailboxState : uint8_t {
    empty = 0,
    busy = 1,      // the request waits for the line or for its answer; writes to the mailbox are refused
    answered = 2,  // MAILBOX_LENGTH bytes: status and whole parts
    silent = 3,    // no answer within MAILBOX_PATIENCE_MS
    broken = 4,    // bytes, but not whole parts (or too many): shown as they came
};

// Offsets 0 to 31: all that is read in one piece, and copied when an index byte arrives.
struct __attribute__((packed)) Front {
    uint8_t version;
    uint8_t leds[3];
    int16_t motors[2];
    int16_t encoders[2];
    uint8_t buttons;
    uint8_t status;
    uint16_t battery;
    uint8_t reset_cause;
    uint8_t revision;
    uint16_t free_stack;
    uint8_t encoder_errors[2];
    uint8_t refused;
    uint8_t bus_resets;
    UwbState uwb_state;
    uint8_t uwb_error;
    uint8_t uwb_bad;
    uint8_t notes_left;
    MailboxState mailbox_state;
    uint8_t mailbox_echo;
    uint16_t mailbox_length;
};

// The UWB block. The sequence number stands at both ends: a reader that has fetched all of it finds them equal.
// It is frozen when a read of its first byte is asked for and at no other time, so that its pieces may be read ticks apart.
struct __attribute__((packed)) UwbReport {
    uint16_t sequence;  // 0: no report yet; then counts up, leaving out 0
    uint16_t age;       // ms since the report came, at the moment of the index byte; 65535 = that or more
    uint8_t count;      // of modules in sight; the first UWB_RANGES of them follow, the others are zero
    uint8_t place[UWB_PLACE_SIZE];                  // int32 x, y, z in mm, quality in %
    uint8_t ranges[UWB_RANGES][UWB_RANGE_SIZE];     // uint16 address, uint32 mm, quality in %
    uint8_t places[UWB_RANGES][UWB_PLACE_SIZE];     // of those modules, which rarely change: last, to be left out
    uint16_t sequence_again;
};

#define LAYOUT_CHECK(name, member) static_assert(offsetof(Front, member) == name, "Front and the table differ");
LAYOUT_CHECK(VERSION, version)
LAYOUT_CHECK(LEDS, leds)
LAYOUT_CHECK(MOTORS, motors)
LAYOUT_CHECK(ENCODERS, encoders)
LAYOUT_CHECK(BUTTONS, buttons)
LAYOUT_CHECK(STATUS, status)
LAYOUT_CHECK(BATTERY, battery)
LAYOUT_CHECK(RESET_CAUSE, reset_cause)
LAYOUT_CHECK(REVISION, revision)
LAYOUT_CHECK(FREE_STACK, free_stack)
LAYOUT_CHECK(ENCODER_ERRORS, encoder_errors)
LAYOUT_CHECK(REFUSED, refused)
LAYOUT_CHECK(BUS_RESETS, bus_resets)
LAYOUT_CHECK(UWB_STATE, uwb_state)
LAYOUT_CHECK(UWB_ERROR, uwb_error)
LAYOUT_CHECK(UWB_BAD, uwb_bad)
LAYOUT_CHECK(NOTES_LEFT, notes_left)
LAYOUT_CHECK(MAILBOX_STATE, mailbox_state)
LAYOUT_CHECK(MAILBOX_ECHO, mailbox_echo)
LAYOUT_CHECK(MAILBOX_LENGTH, mailbox_length)
#undef LAYOUT_CHECK
static_assert(sizeof(Front) == UWB, "the front ends where the UWB block begins");
static_assert(sizeof(UwbReport) == 100, "UwbReport and the table differ");
static_assert(NOTES + 1 + 2 * TUNE_NOTES <= MAILBOX_TOKEN, "the notes run into the mailbox");
static_assert(MAILBOX_WINDOW + WINDOW_SIZE <= JOINED, "an index is one byte");
static_assert(4 * (ONWARD - 1 - JOINED) >= UWB + sizeof(UwbReport) - UWB_PLACE_SIZE - 2 - 3, "a place can be joined");

}  // namespace layout
