#include "mailbox.h"

#include "front.h"

namespace mailbox {

uint8_t bytes[SIZE];

namespace {

uint8_t page = 0;
volatile uint8_t length = 0;

uint8_t* window()
{
    return bytes + static_cast<uint16_t>(page) * layout::WINDOW_SIZE;
}

}  // namespace

bool write(uint8_t offset, const uint8_t* data, uint8_t count)
{
    if (offset == 0) {
        if (data[0] >= PAGES)
            return false;
        page = data[0];
        ++data;
        --count;
    } else {
        --offset;
    }
    uint8_t* to = window() + offset;
    while (count-- != 0)
        *to++ = *data++;
    return true;
}

uint8_t read(uint8_t offset)
{
    return offset == 0 ? page : window()[offset - 1];
}

bool go(uint8_t token, uint8_t request)
{
    if (request == 0)
        return false;
    length = request;
    front.mailbox_echo = token;
    front.mailbox_length = 0;
    front.mailbox_state = layout::MailboxState::busy;
    return true;
}

uint16_t request_length()
{
    return length;
}

}  // namespace mailbox
