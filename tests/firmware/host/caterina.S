; A bootloader that decides as Pololu's does for the A-Star and Balboa (4 KB at 0x7000), without its 750 ms and its USB:
; it clears the reset flags but for brown-out, takes the key at 0x0800, and stays if a watchdog reset came with the key.
; Else it starts the program at 0. While it stays, r24 is 0xB0.
#include <avr/io.h>

.section .text
main:
    clr r1
    out _SFR_IO_ADDR(SREG), r1
    lds r18, 0x0800
    lds r19, 0x0801
    sts 0x0800, r1
    sts 0x0801, r1
    in r24, _SFR_IO_ADDR(MCUSR)
    mov r25, r24
    andi r25, ~((1 << PORF) | (1 << EXTRF) | (1 << WDRF))
    sbrc r24, PORF
    andi r25, ~(1 << BORF)
    out _SFR_IO_ADDR(MCUSR), r25
    wdr
    ldi r25, (1 << WDCE) | (1 << WDE)
    sts WDTCSR, r25
    sts WDTCSR, r1
    sbrs r24, WDRF
    jmp 0
    cpi r18, 0x77
    brne program
    cpi r19, 0x77
    brne program
    ldi r24, 0xB0
stay:
    rjmp stay
program:
    jmp 0
