/* Start-up and devices of a Cortex-M4F on Arm's MPS2 board (QEMU's mps2-an386). */

#include "board.h"

const void *const board_image_memory = (const void *)0x21000000;
const size_t board_image_capacity = 16u << 20;

/* Of the linker script. */
extern uint32_t stack_top[], data_start[], data_end[], data_load[], bss_start[], bss_end[];

int main(void);

/* APB UART of the Cortex-M System Design Kit (Arm DDI 0479, section 4.3). */
#define UART_DATA (*(volatile uint32_t *)0x40004000)
#define UART_STATE (*(volatile uint32_t *)0x40004004)
#define UART_CONTROL (*(volatile uint32_t *)0x40004008)
#define UART_DIVIDER (*(volatile uint32_t *)0x40004010)
#define TRANSMIT_FULL 1u
#define TRANSMIT_ENABLE 1u

/* Coprocessor access control (Armv7-M, B3.2.20): full access to the floating-point unit. */
#define CPACR (*(volatile uint32_t *)0xE000ED88)
#define FPU_ACCESS (0xFu << 20)

void board_send(char byte)
{
    while (UART_STATE & TRANSMIT_FULL)
        ;
    UART_DATA = (uint8_t)byte;
}

/* Arm semihosting, SYS_EXIT_EXTENDED with the reason ADP_Stopped_ApplicationExit. */
_Noreturn void board_exit(int status)
{
    const uint32_t block[2] = { 0x20026, (uint32_t)status };
    register uint32_t operation __asm__("r0") = 0x20;
    register const uint32_t *argument __asm__("r1") = block;
    __asm__ volatile("bkpt 0xab" : "+r"(operation) : "r"(argument) : "memory");
    for (;;)
        ;
}

static _Noreturn void fault(void)
{
    board_exit(101);
}

_Noreturn void reset(void)
{
    const uint32_t *from = data_load;
    for (uint32_t *to = data_start; to < data_end; to++)
        *to = *from++;
    for (uint32_t *to = bss_start; to < bss_end; to++)
        *to = 0;
    CPACR |= FPU_ACCESS;
    __asm__ volatile("dsb\n\tisb" ::: "memory");
    UART_DIVIDER = 16;
    UART_CONTROL = TRANSMIT_ENABLE;
    board_exit(main());
}

/* Armv7-M, B1.5.2: initial stack pointer, then handlers of reset, NMI and the faults. No interrupt is enabled. */
__attribute__((section(".vectors"), used)) static const void *const vectors[] = {
    stack_top, reset, fault, fault, fault, fault, fault,
};
