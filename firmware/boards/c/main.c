/* The self-test of a model image, then one inference over inputs that are zero everywhere, by the C interface. */

#include "board.h"
#include "firmware.h"

#define ARENA_BYTES (160 * 1024)

static fw_engine engine;
static _Alignas(64) uint8_t arena[ARENA_BYTES];

static void print(const char *text)
{
    while (*text != '\0')
        board_send(*text++);
}

static void print_number(int32_t number)
{
    char digits[10];
    size_t count = 0;
    uint32_t rest = number < 0 ? -(uint32_t)number : (uint32_t)number;
    do
        digits[count++] = (char)('0' + rest % 10);
    while ((rest /= 10) != 0);
    if (number < 0)
        board_send('-');
    while (count != 0)
        board_send(digits[--count]);
}

static void print_fact(const char *name, uint32_t number)
{
    print(name);
    print_number((int32_t)number);
    print("\n");
}

/* Ends the run with what failed: the step, the words of the status, and the engine's message. */
static void demand(const char *what, fw_status status)
{
    char message[160];
    if (status == FW_STATUS_OK)
        return;
    print("error: ");
    print(what);
    print(": ");
    print(fw_status_text(status));
    if (fw_engine_explain(&engine, message, sizeof message) == FW_STATUS_OK && message[0] != '\0') {
        print(": ");
        print(message);
    }
    print("\n");
    board_exit(1);
}

static void self_test(void)
{
    fw_progress progress;
    demand("self-test", fw_self_test_start(&engine));
    do /* a program that drives would feed its watchdog here */
        demand("self-test", fw_self_test_step(&engine, &progress));
    while (progress.done < progress.steps);
    print("self-test passed\n");
}

/* The real number 0 in every element of every input. */
static void fill_inputs(uint32_t inputs)
{
    for (uint32_t input = 0; input < inputs; input++) {
        fw_port port;
        uint8_t *bytes;
        size_t length;
        demand("input", fw_input_port(&engine, input, &port));
        demand("input", fw_input(&engine, input, &bytes, &length));
        for (size_t i = 0; i < length; i++)
            bytes[i] = port.element == FW_ELEMENT_I8 ? (uint8_t)port.zero_point : 0;
    }
}

static void infer(void)
{
    fw_progress progress;
    demand("inference", fw_begin(&engine));
    do
        demand("inference", fw_step(&engine, &progress));
    while (progress.done < progress.steps);
}

static void print_waypoints(void)
{
    fw_waypoint waypoints[FW_MAX_WAYPOINTS];
    size_t count;
    demand("waypoints", fw_waypoints(&engine, 0, waypoints, FW_MAX_WAYPOINTS, &count));
    for (size_t i = 0; i < count; i++) {
        print("waypoint, 1/65536 m: right ");
        print_number(waypoints[i].right);
        print(", forward ");
        print_number(waypoints[i].forward);
        print("\n");
    }
}

int main(void)
{
    fw_image_info info;
    fw_region region = { arena, sizeof arena };
    size_t bytes;
    demand("image", fw_image_length(board_image_memory, board_image_capacity, &bytes));
    demand("image", fw_image_parse(board_image_memory, bytes, &info));
    demand("image", fw_image_check(board_image_memory, bytes));
    print("firmware ");
    print(fw_version());
    print(", model ");
    print(info.name);
    print_fact("\nimage bytes ", (uint32_t)bytes);
    print_fact("arena bytes ", info.regions[0].bytes);
    print_fact("steps ", info.steps);
    demand("engine", fw_engine_init(&engine, board_image_memory, bytes, &region, 1));
    self_test();
    fill_inputs(info.inputs);
    infer();
    print_waypoints();
    return 0;
}
