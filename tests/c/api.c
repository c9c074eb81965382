/* The C interface on the host: what it refuses, and one inference over inputs that are zero everywhere. Prints the
 * waypoints; ends with 1 at the first promise that is not kept. Argument: a model image. */

#include "firmware.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define EXPECT(call, expected)                                                                                         \
    do {                                                                                                               \
        fw_status found = (call);                                                                                      \
        if (found != (expected)) {                                                                                     \
            printf("line %d: %s: %s\n", __LINE__, #call, fw_status_text(found));                                       \
            exit(1);                                                                                                   \
        }                                                                                                              \
    } while (0)

static void *read_file(const char *path, size_t *bytes)
{
    FILE *file = fopen(path, "rb");
    if (file == NULL || fseek(file, 0, SEEK_END) != 0)
        exit(2);
    *bytes = (size_t)ftell(file);
    rewind(file);
    void *memory = aligned_alloc(16, *bytes);
    if (memory == NULL || fread(memory, 1, *bytes, file) != *bytes)
        exit(2);
    fclose(file);
    return memory;
}

static void refuses_images(unsigned char *image, size_t bytes)
{
    fw_image_info info;
    size_t length;
    char text[200];
    EXPECT(fw_image_length(image, bytes, &length), FW_STATUS_OK);
    if (length != bytes)
        exit(1);
    EXPECT(fw_image_length(image, bytes - 1, &length), FW_STATUS_IMAGE_MALFORMED);
    EXPECT(fw_image_length(image, 3, &length), FW_STATUS_IMAGE_MALFORMED);
    EXPECT(fw_image_parse(NULL, bytes, &info), FW_STATUS_NULL_POINTER);
    EXPECT(fw_image_parse(image, bytes, NULL), FW_STATUS_NULL_POINTER);
    EXPECT(fw_image_parse(image + 4, bytes - 4, &info), FW_STATUS_MISALIGNED);
    EXPECT(fw_image_parse(image, SIZE_MAX, &info), FW_STATUS_WRONG_SIZE);
    EXPECT(fw_image_parse(image, bytes - 16, &info), FW_STATUS_IMAGE_MALFORMED);
    EXPECT(fw_image_check(image, bytes), FW_STATUS_OK);
    image[bytes / 2] ^= 1;
    EXPECT(fw_image_parse(image, bytes, &info), FW_STATUS_OK);
    EXPECT(fw_image_check(image, bytes), FW_STATUS_IMAGE_DAMAGED);
    EXPECT(fw_image_explain(image, bytes, text, sizeof text), FW_STATUS_OK);
    if (strstr(text, "constants section: damaged: CRC ") == NULL)
        exit(1);
    image[bytes / 2] ^= 1;
    EXPECT(fw_image_explain(image, bytes, text, sizeof text), FW_STATUS_OK);
    if (text[0] != '\0')
        exit(1);
}

static void refuses_engines(const void *image, size_t bytes, fw_region region)
{
    static fw_engine engine;
    fw_region misaligned = { (char *)region.memory + 4, region.bytes - 4 };
    fw_region small = { region.memory, region.bytes - 1 };
    fw_region shared = { (void *)image, bytes };
    EXPECT(fw_begin(&engine), FW_STATUS_NOT_INITIALIZED);
    EXPECT(fw_begin(NULL), FW_STATUS_NULL_POINTER);
    EXPECT(fw_engine_init(NULL, image, bytes, &region, 1), FW_STATUS_NULL_POINTER);
    EXPECT(fw_engine_init((fw_engine *)((char *)&engine + 1), image, bytes, &region, 1), FW_STATUS_MISALIGNED);
    EXPECT(fw_engine_init(&engine, image, bytes, NULL, 1), FW_STATUS_NULL_POINTER);
    EXPECT(fw_engine_init(&engine, image, bytes, &region, 0), FW_STATUS_REGION_COUNT);
    EXPECT(fw_engine_init(&engine, image, bytes, &misaligned, 1), FW_STATUS_MISALIGNED);
    EXPECT(fw_engine_init(&engine, image, bytes, &small, 1), FW_STATUS_REGION_TOO_SMALL);
    EXPECT(fw_engine_init(&engine, image, bytes, &shared, 1), FW_STATUS_OVERLAP);
    EXPECT(fw_run(&engine), FW_STATUS_NOT_INITIALIZED);
}

static void refuses_calls(fw_engine *engine, const fw_image_info *info)
{
    fw_port port;
    fw_progress progress;
    fw_waypoint waypoints[FW_MAX_WAYPOINTS];
    uint8_t *bytes;
    const uint8_t *output;
    size_t count;
    char text[100];
    fw_bytes inputs[2] = { { text, 1 }, { text, 1 } };
    EXPECT(fw_step(engine, &progress), FW_STATUS_NOT_STARTED);
    EXPECT(fw_output(engine, 0, &output, &count), FW_STATUS_NOT_DONE);
    EXPECT(fw_start(engine, inputs, 1), info->inputs == 1 ? FW_STATUS_INPUT_BYTES : FW_STATUS_INPUT_COUNT);
    EXPECT(fw_engine_explain(engine, text, sizeof text), FW_STATUS_OK);
    if (strcmp(text, "1 inputs given, the network has 4") != 0)
        exit(1);
    EXPECT(fw_start(engine, NULL, info->inputs), FW_STATUS_NULL_POINTER);
    EXPECT(fw_input_port(engine, info->inputs, &port), FW_STATUS_NO_SUCH_PORT);
    EXPECT(fw_output_port(engine, SIZE_MAX, &port), FW_STATUS_NO_SUCH_PORT);
    EXPECT(fw_input(engine, info->inputs, &bytes, &count), FW_STATUS_NO_SUCH_PORT);
    EXPECT(fw_self_test(engine), FW_STATUS_OK);
    EXPECT(fw_waypoints(engine, 0, waypoints, 0, &count), FW_STATUS_TOO_SHORT);
    EXPECT(fw_waypoints(engine, 1, waypoints, FW_MAX_WAYPOINTS, &count), FW_STATUS_NO_SUCH_PORT);
}

/* By copies of the inputs; the program on the board fills them in place. */
static void infers(fw_engine *engine, const fw_image_info *info)
{
    fw_bytes inputs[16];
    fw_waypoint waypoints[FW_MAX_WAYPOINTS];
    size_t count;
    for (size_t i = 0; i < info->inputs; i++) {
        fw_port port;
        EXPECT(fw_input_port(engine, i, &port), FW_STATUS_OK);
        void *memory = malloc(port.bytes);
        memset(memory, port.element == FW_ELEMENT_I8 ? port.zero_point : 0, port.bytes);
        inputs[i] = (fw_bytes){ memory, port.bytes };
    }
    EXPECT(fw_start(engine, inputs, info->inputs), FW_STATUS_OK);
    EXPECT(fw_run(engine), FW_STATUS_OK);
    EXPECT(fw_waypoints(engine, 0, waypoints, FW_MAX_WAYPOINTS, &count), FW_STATUS_OK);
    for (size_t i = 0; i < count; i++)
        printf("waypoint, 1/65536 m: right %d, forward %d\n", (int)waypoints[i].right, (int)waypoints[i].forward);
}

int main(int argc, char **argv)
{
    static fw_engine engine;
    fw_image_info info;
    size_t bytes;
    if (argc != 2)
        return 2;
    unsigned char *image = read_file(argv[1], &bytes);
    refuses_images(image, bytes);
    EXPECT(fw_image_parse(image, bytes, &info), FW_STATUS_OK);
    fw_region_need need = info.regions[0];
    size_t rounded = (need.bytes + need.alignment - 1) / need.alignment * need.alignment;
    fw_region region = { aligned_alloc(need.alignment, rounded), need.bytes };
    refuses_engines(image, bytes, region);
    EXPECT(fw_engine_init(&engine, image, bytes, &region, 1), FW_STATUS_OK);
    refuses_calls(&engine, &info);
    infers(&engine, &info);
    return 0;
}
