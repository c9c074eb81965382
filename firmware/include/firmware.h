/*
 * The C interface of the runtime: a parsed model image, an engine in the caller's storage, inputs, steps, outputs.
 *
 * Nothing is allocated and nothing is global: an engine lives in a `fw_engine` that the caller provides, and works in
 * memory regions that the caller provides. Their sizes and alignments are what `fw_image_parse` tells of an image.
 *
 * Every call that can fail answers an `fw_status`; `FW_STATUS_OK` is 0. A call that fails has written nothing through
 * its result pointers. `fw_status_text` gives the words of a status, `fw_image_explain` and `fw_engine_explain` the
 * whole message: what is wrong, where, found, expected.
 *
 * Null pointers, misaligned pointers, lengths that cannot be, memory that overlaps, and an engine that was never set
 * up (its storage still being zero) are refused. What cannot be checked is the caller's part:
 *
 * - Pointers with a length point to that many bytes; result pointers to what they are declared as.
 * - The image does not change, and image, regions and engine stay where they are, as long as the engine is used.
 * - The regions are the engine's alone. Bytes of an input or output that a call gave out may be used until the next
 *   call with the same engine.
 * - An engine is used by one thread or interrupt at a time. Different engines are independent.
 *
 * A program in outline:
 *
 * static fw_engine engine;
 * static _Alignas(64) uint8_t arena[160 * 1024];
 *
 * fw_region region = { arena, sizeof arena };
 * fw_status status = fw_engine_init(&engine, image, image_bytes, &region, 1);
 * if (status == FW_STATUS_OK) status = fw_self_test(&engine);
 *
 * for each frame:
 *     fw_input(&engine, i, &bytes, &length), then fill bytes[0..length], for every input i
 *     fw_begin(&engine);
 *     do status = fw_step(&engine, &progress);   // between two steps: feed the watchdog, yield
 *     while (status == FW_STATUS_OK && progress.done < progress.steps);
 *     fw_waypoints(&engine, 0, waypoints, FW_MAX_WAYPOINTS, &count);
 *
 * Generated; not to be edited.
 */

#ifndef FIRMWARE_H
#define FIRMWARE_H

#include <stddef.h>
#include <stdint.h>

/**
 * Words of an engine's storage.
 */
#define FW_ENGINE_WORDS 48

/**
 * Most memory regions of an image.
 */
#define FW_MAX_REGIONS 4

/**
 * Most waypoints of an output.
 */
#define FW_MAX_WAYPOINTS 16

/**
 * Bytes of a model's name with the zero behind it.
 */
#define FW_MODEL_NAME_BYTES 33

/**
 * Bytes of a port's name with the zero behind it.
 */
#define FW_PORT_NAME_BYTES 25

/**
 * What a call answers. A number never changes its meaning; new ones are added at the end.
 */
enum fw_status
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * Done.
     */
    FW_STATUS_OK = 0,
    /**
     * A pointer is null.
     */
    FW_STATUS_NULL_POINTER = 1,
    /**
     * A pointer is not aligned as its type, the image (16) or the region (`fw_image_parse` tells) asks for.
     */
    FW_STATUS_MISALIGNED = 2,
    /**
     * A length is negative as a signed number, or the memory would wrap around the address space.
     */
    FW_STATUS_WRONG_SIZE = 3,
    /**
     * Engine, image, regions or inputs share memory.
     */
    FW_STATUS_OVERLAP = 4,
    /**
     * `fw_engine_init` has not set up this engine, or it failed.
     */
    FW_STATUS_NOT_INITIALIZED = 5,
    /**
     * The number of regions differs from the image's.
     */
    FW_STATUS_REGION_COUNT = 6,
    /**
     * A region has fewer bytes than the image asks for.
     */
    FW_STATUS_REGION_TOO_SMALL = 7,
    /**
     * The bytes are no model image, or a truncated or contradictory one.
     */
    FW_STATUS_IMAGE_MALFORMED = 8,
    /**
     * The image is of another format, or needs features that this library does not have.
     */
    FW_STATUS_IMAGE_UNSUPPORTED = 9,
    /**
     * A section of the image does not agree with its CRC.
     */
    FW_STATUS_IMAGE_DAMAGED = 10,
    /**
     * The image is no longer what `fw_engine_init` accepted; the inference is abandoned.
     */
    FW_STATUS_IMAGE_CHANGED = 11,
    /**
     * The image uses a kernel that this library does not have.
     */
    FW_STATUS_KERNEL_MISSING = 12,
    /**
     * The number of inputs differs from the network's.
     */
    FW_STATUS_INPUT_COUNT = 13,
    /**
     * The length of an input differs from the tensor's.
     */
    FW_STATUS_INPUT_BYTES = 14,
    /**
     * The network has no input or output of this index.
     */
    FW_STATUS_NO_SUCH_PORT = 15,
    /**
     * A step was asked for, but no inference was started.
     */
    FW_STATUS_NOT_STARTED = 16,
    /**
     * An output was asked for before the last step was done.
     */
    FW_STATUS_NOT_DONE = 17,
    /**
     * The output does not hold waypoints.
     */
    FW_STATUS_NO_WAYPOINTS = 18,
    /**
     * The array is too short for what the call has to write.
     */
    FW_STATUS_TOO_SHORT = 19,
    /**
     * The image holds no known answer, so there is no self-test.
     */
    FW_STATUS_NO_KNOWN_ANSWER = 20,
    /**
     * A step of the self-test gave other bytes than the image's known answer.
     */
    FW_STATUS_WRONG_ANSWER = 21,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum fw_status fw_status;
#else
typedef int32_t fw_status;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * Type of the elements of an input or output.
 */
enum fw_element
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * Signed 8-bit codes: `real = scale * (code - zero_point)`.
     */
    FW_ELEMENT_I8 = 0,
    /**
     * Signed 16-bit codes, zero point 0.
     */
    FW_ELEMENT_I16 = 1,
    /**
     * Signed 32-bit words, zero point 0.
     */
    FW_ELEMENT_I32 = 2,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum fw_element fw_element;
#else
typedef int32_t fw_element;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * Memory that an image asks for.
 */
typedef struct fw_region_need {
    /**
     * Bytes.
     */
    uint32_t bytes;
    /**
     * Alignment of the first byte: a power of two, 16 to 4096.
     */
    uint32_t alignment;
} fw_region_need;

/**
 * What an image is and what it asks for.
 */
typedef struct fw_image_info {
    /**
     * Name of the model, UTF-8.
     */
    char name[FW_MODEL_NAME_BYTES];
    /**
     * SHA-256 of the quantized model, all zero where unknown.
     */
    uint8_t model_digest[32];
    /**
     * Digest that names the build, all zero where unknown.
     */
    uint8_t build_digest[32];
    /**
     * Multiply-accumulates and elements touched in one inference.
     */
    uint64_t work;
    /**
     * Steps of one inference.
     */
    uint32_t steps;
    /**
     * Inputs of the network.
     */
    uint32_t inputs;
    /**
     * Outputs of the network.
     */
    uint32_t outputs;
    /**
     * Regions that an engine needs.
     */
    uint32_t region_count;
    /**
     * What each has to be; zeros behind the last.
     */
    struct fw_region_need regions[FW_MAX_REGIONS];
} fw_image_info;

/**
 * Storage of an engine: the caller's, as static or automatic storage, filled with zeros. `fw_engine_init` sets it up;
 * what it holds is the library's business. It must not be moved or copied while it is in use.
 */
typedef struct fw_engine {
    /**
     * Not to be touched.
     */
    uint64_t state[FW_ENGINE_WORDS];
} fw_engine;

/**
 * Memory that an engine works in.
 */
typedef struct fw_region {
    /**
     * First byte, aligned as `fw_image_info` says for the region of this index.
     */
    void *memory;
    /**
     * Its bytes: at least as many as `fw_image_info` says.
     */
    size_t bytes;
} fw_region;

/**
 * An input or output of the network: `height * width * channels` elements, channel fastest, little-endian.
 */
typedef struct fw_port {
    /**
     * Name, UTF-8: `rgb`, `bev`, `velocity`, `goal`, `waypoints` and others.
     */
    char name[FW_PORT_NAME_BYTES];
    /**
     * Type of the elements.
     */
    fw_element element;
    /**
     * Rows.
     */
    uint16_t height;
    /**
     * Columns.
     */
    uint16_t width;
    /**
     * Channels.
     */
    uint16_t channels;
    /**
     * Code of the real number 0.
     */
    int16_t zero_point;
    /**
     * Real step of one code. The library does not compute with it.
     */
    float scale;
    /**
     * Bytes of the tensor.
     */
    uint32_t bytes;
} fw_port;

/**
 * An input's bytes.
 */
typedef struct fw_bytes {
    /**
     * First byte.
     */
    const void *data;
    /**
     * Number of bytes.
     */
    size_t bytes;
} fw_bytes;

/**
 * How far an inference is: outputs can be read when `done == steps`.
 */
typedef struct fw_progress {
    /**
     * Steps done.
     */
    uint32_t done;
    /**
     * Steps in all.
     */
    uint32_t steps;
} fw_progress;

/**
 * Where to be, half a second after the waypoint before (the first: half a second from now), in the vehicle's frame.
 */
typedef struct fw_waypoint {
    /**
     * To the right, in 1/65536 m.
     */
    int32_t right;
    /**
     * Ahead, in 1/65536 m.
     */
    int32_t forward;
} fw_waypoint;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * Version of the library, such as "0.1.0".
 */
const char *fw_version(void);

/**
 * What a status means, in a few words; of any other number: "unknown status".
 */
const char *fw_status_text(int32_t status);

/**
 * How long the image is that begins at `memory`, of which `capacity` bytes can be read: for an image in flash whose
 * length is known to its header alone.
 */
fw_status fw_image_length(const void *memory, size_t capacity, size_t *bytes);

/**
 * Whether the bytes at `image` (aligned to 16) are a model image that this library can run, and what it asks for.
 * Reads header, tables and program, not the weights.
 */
fw_status fw_image_parse(const void *image, size_t bytes, struct fw_image_info *info);

/**
 * `fw_image_parse`, then every byte of the image against its CRCs. Takes as long as the image is large.
 */
fw_status fw_image_check(const void *image, size_t bytes);

/**
 * Why `fw_image_check` refuses an image: writes the message, ended by a zero and cut to `capacity` bytes, to `text`.
 * An accepted image gives an empty text. Answers what the writing gave, not what is wrong with the image.
 */
fw_status fw_image_explain(const void *image, size_t bytes, char *text, size_t capacity);

/**
 * Sets up an engine: parses the image and takes the regions, of which there must be as many as `fw_image_info` says,
 * each as large and as aligned. Whatever the regions hold is overwritten before it is read. An engine that is set up
 * may be set up anew.
 */
fw_status fw_engine_init(struct fw_engine *engine,
                         const void *image,
                         size_t image_bytes,
                         const struct fw_region *regions,
                         size_t region_count);

/**
 * Why the last call with this engine failed: writes the message, ended by a zero and cut to `capacity` bytes, to
 * `text`; empty where it did not fail or its pointers were refused.
 */
fw_status fw_engine_explain(struct fw_engine *engine, char *text, size_t capacity);

/**
 * What the input of an index is.
 */
fw_status fw_input_port(struct fw_engine *engine, size_t input, struct fw_port *port);

/**
 * What the output of an index is.
 */
fw_status fw_output_port(struct fw_engine *engine, size_t output, struct fw_port *port);

/**
 * The bytes of an input, to be filled in place before `fw_begin`. Abandons an inference that is under way. An
 * inference overwrites its inputs: each must be filled anew for every one.
 */
fw_status fw_input(struct fw_engine *engine, size_t input, uint8_t **bytes, size_t *length);

/**
 * Begins an inference over what was written to the inputs (`fw_input`).
 */
fw_status fw_begin(struct fw_engine *engine);

/**
 * Begins an inference: copies `count` inputs, in the order of their indices. Abandons one that is under way.
 */
fw_status fw_start(struct fw_engine *engine, const struct fw_bytes *inputs, size_t count);

/**
 * Runs the next step of the inference to its end. When `progress->done == progress->steps` the outputs can be read;
 * another call does nothing then.
 */
fw_status fw_step(struct fw_engine *engine, struct fw_progress *progress);

/**
 * Runs all steps that remain.
 */
fw_status fw_run(struct fw_engine *engine);

/**
 * The bytes of an output, after the last step.
 */
fw_status fw_output(struct fw_engine *engine, size_t output, const uint8_t **bytes, size_t *length);

/**
 * The waypoints of an output, after the last step: at most `capacity`, their number goes to `count`. An array of
 * `FW_MAX_WAYPOINTS` is always long enough.
 */
fw_status fw_waypoints(struct fw_engine *engine,
                       size_t output,
                       struct fw_waypoint *waypoints,
                       size_t capacity,
                       size_t *count);

/**
 * The whole self-test: an inference over seeded inputs, every step's bytes compared with the image's known answer.
 */
fw_status fw_self_test(struct fw_engine *engine);

/**
 * Begins the self-test, for a program that goes on with `fw_self_test_step`.
 */
fw_status fw_self_test_start(struct fw_engine *engine);

/**
 * Runs the next step of the self-test; it has passed when `progress->done == progress->steps`.
 */
fw_status fw_self_test_step(struct fw_engine *engine, struct fw_progress *progress);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* FIRMWARE_H */
