/* What the program sees of a board. */
#ifndef BOARD_H
#define BOARD_H

#include <stddef.h>
#include <stdint.h>

/* Memory that a model image lies at the start of. */
extern const void *const board_image_memory;
extern const size_t board_image_capacity;

/* Sends a byte to the console. */
void board_send(char byte);

/* Ends the run; an emulator or debugger takes the status. */
_Noreturn void board_exit(int status);

#endif
