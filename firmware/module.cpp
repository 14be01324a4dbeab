#include "module.h"

#include <string.h>

#include <util/atomic.h>

#include "front.h"
#include "location.h"
#include "mailbox.h"
#include "reports.h"
#include "tlv.h"
#include "uart.h"

namespace module {

namespace {

using layout::MailboxState;
using layout::UwbState;

constexpr uint8_t PERIOD_MS = 100;      // the module's own highest rate (API guide, dwm_upd_rate_set: unit of 100 ms)
constexpr uint8_t PATIENCE_MS = 90;     // for an answer to loc_get; so that polls stay 100 ms apart
constexpr uint8_t SILENCE_MS = 5;       // 50 byte times: whatever was begun will not go on
constexpr uint16_t MAILBOX_PATIENCE_MS = 500;  // calls that write the module's flash are slow

const uint8_t LOC_GET[] = {0x0C, 0x00};

enum class Line : uint8_t { idle, polling, relaying };

LocationReader reader;
Line line = Line::idle;
uint32_t line_since = 0;    // when the request was sent
uint32_t last_poll = 0;
uint32_t last_byte = 0;
bool heard = false;         // any byte since the request
uint16_t answer_count = 0;  // bytes of a relayed answer
bool answer_spoilt = false;  // bytes of it were lost

void set_state(UwbState state)
{
    front.uwb_state = state;
    if (state == UwbState::broken)
        front.uwb_bad = static_cast<uint8_t>(front.uwb_bad + 1);
}

void publish(uint32_t now)
{
    layout::UwbReport& report = reports::next();
    const uint8_t count = reader.count();
    report.count = count;
    memcpy(report.place, reader.place(), sizeof report.place);
    const uint8_t kept = count < layout::UWB_RANGES ? count : layout::UWB_RANGES;
    memset(report.ranges, 0, sizeof report.ranges);
    memset(report.places, 0, sizeof report.places);
    for (uint8_t n = 0; n < kept; ++n) {
        memcpy(report.ranges[n], reader.range(n), sizeof report.ranges[0]);
        memcpy(report.places[n], reader.range(n) + sizeof report.ranges[0], sizeof report.places[0]);
    }
    reports::publish(now);
}

void begin(Line what, const uint8_t* bytes, uint16_t count, uint32_t now)
{
    line = what;
    line_since = now;
    heard = false;
    reader.reset();
    uart::send(bytes, count);
}

void poll_byte(uint8_t byte, uint32_t now)
{
    switch (reader.feed(byte)) {
    case LocationReader::location:
        publish(now);
        set_state(UwbState::ok);
        line = Line::idle;
        break;
    case LocationReader::refusal:
        front.uwb_error = reader.error();
        set_state(UwbState::refused);
        line = Line::idle;
        break;
    case LocationReader::more:
        break;
    }
}

void poll_time(uint32_t now)
{
    if (reader.begun() && now - last_byte >= SILENCE_MS)
        reader.reset();
    if (now - line_since < PATIENCE_MS)
        return;
    set_state(heard ? UwbState::broken : UwbState::silent);
    line = Line::idle;
}

// The request stands where the answer will: what comes before it is sent (echo of a module in shell mode) is dropped.
void relay_byte(uint8_t byte)
{
    if (uart::sending())
        return;
    if (answer_count < mailbox::SIZE)
        mailbox::bytes[answer_count++] = byte;
    else
        answer_spoilt = true;
}

void relay_time(uint32_t now)
{
    MailboxState state;
    if (answer_count != 0 && now - last_byte >= SILENCE_MS)
        state = !answer_spoilt && tlv::whole(mailbox::bytes, answer_count) ? MailboxState::answered
                                                                           : MailboxState::broken;
    else if (answer_count == 0 && now - line_since >= MAILBOX_PATIENCE_MS)
        state = MailboxState::silent;
    else
        return;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        front.mailbox_length = answer_count;
        front.mailbox_state = state;
    }
    line = Line::idle;
}

}  // namespace

void start()
{
    uart::start();
}

void run(uint32_t now)
{
    if (uart::damaged()) {
        reader.reset();
        answer_spoilt = true;
        heard = true;
    }
    uint8_t byte;
    while (uart::take(byte)) {
        last_byte = now;
        heard = true;
        if (line == Line::polling)
            poll_byte(byte, now);
        else if (line == Line::relaying)
            relay_byte(byte);
    }
    if (line == Line::polling)
        poll_time(now);
    else if (line == Line::relaying)
        relay_time(now);
    if (line != Line::idle)
        return;
    if (front.mailbox_state == MailboxState::busy) {
        answer_count = 0;
        answer_spoilt = false;
        set_state(UwbState::paused);
        begin(Line::relaying, mailbox::bytes, mailbox::request_length(), now);
    } else if (now - last_poll >= PERIOD_MS) {
        last_poll = now - last_poll >= 2 * PERIOD_MS ? now : last_poll + PERIOD_MS;
        begin(Line::polling, LOC_GET, sizeof LOC_GET, now);
    }
}

}  // namespace module
