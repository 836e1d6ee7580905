/* Keeps what OpenCL has compiled, for Contexts to come with the same kernels.
 *
 * OpenMM compiles some hundred kernels for each Context, which takes a second on a CPU, where a step takes a millisecond.
 * Many Contexts of tests have the same kernels. The linker finds the functions of a preloaded library before those of
 * OpenCL: these return a program that is made from the binary of an earlier one of the same source. They also add options
 * of the environment to those of OpenMM.
 */
#include "../../studies/launches/opencl.h"

#define CL_CONTEXT_DEVICES 0x1081
#define CL_PROGRAM_BINARY_SIZES 0x1165
#define CL_PROGRAM_BINARIES 0x1166

#define OPTIONS "OPENMM_SIER_OPENCL_OPTIONS"

/* A source that was compiled on one device. */
struct program {
    object unfinished;
    char *source;
    unsigned char *binary;
    size_t size;
};

/* The last ones, the oldest of which is replaced. */
#define MOST 256
static struct program programs[MOST];
static int next;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

static char *joined(cl_uint number, const char **strings, const size_t *lengths)
{
    size_t size = 1;
    for (cl_uint i = 0; i < number; i++)
        size += lengths != NULL && lengths[i] != 0 ? lengths[i] : strlen(strings[i]);
    char *text = malloc(size), *end = text;
    for (cl_uint i = 0; i < number; i++) {
        size_t length = lengths != NULL && lengths[i] != 0 ? lengths[i] : strlen(strings[i]);
        memcpy(end, strings[i], length);
        end += length;
    }
    *end = 0;
    return text;
}

/* A program from the binary of a source, or NULL. */
static object from_binary(object context, const char *source, cl_int *error)
{
    cl_int (*information)(object, cl_uint, size_t, void *, size_t *) = find_opencl("clGetContextInfo");
    object (*create)(object, cl_uint, const object *, const size_t *, const unsigned char **, cl_int *, cl_int *)
        = find_opencl("clCreateProgramWithBinary");
    object device, program = NULL;
    cl_int status;
    for (int i = 0; i < MOST && program == NULL; i++)
        if (programs[i].binary != NULL && strcmp(programs[i].source, source) == 0
            && information(context, CL_CONTEXT_DEVICES, sizeof device, &device, NULL) == 0) {
            const unsigned char *binary = programs[i].binary;
            program = create(context, 1, &device, &programs[i].size, &binary, &status, error);
        }
    return program;
}

object clCreateProgramWithSource(object context, cl_uint number, const char **strings, const size_t *lengths,
                                 cl_int *error)
{
    object (*own)(object, cl_uint, const char **, const size_t *, cl_int *) = find_opencl("clCreateProgramWithSource");
    char *source = joined(number, strings, lengths);
    pthread_mutex_lock(&lock);
    object program = from_binary(context, source, error);
    if (program != NULL)
        free(source);
    else {
        program = own(context, number, strings, lengths, error);
        free(programs[next].source);
        free(programs[next].binary);
        programs[next] = (struct program) {program, source, NULL, 0};
        next = (next + 1) % MOST;
    }
    pthread_mutex_unlock(&lock);
    return program;
}

/* Keep the binary of a program that was compiled from its source. */
static void keep(object program, int is_built)
{
    cl_int (*information)(object, cl_uint, size_t, void *, size_t *) = find_opencl("clGetProgramInfo");
    for (int i = 0; i < MOST; i++) {
        struct program *each = &programs[i];
        if (each->unfinished != program)
            continue;
        each->unfinished = NULL;
        if (!is_built || information(program, CL_PROGRAM_BINARY_SIZES, sizeof each->size, &each->size, NULL) != 0)
            continue;
        unsigned char *binary = malloc(each->size);
        if (information(program, CL_PROGRAM_BINARIES, sizeof binary, &binary, NULL) == 0)
            each->binary = binary;
    }
}

cl_int clBuildProgram(object program, cl_uint number, const object *devices, const char *options, void *notify,
                      void *data)
{
    cl_int (*own)(object, cl_uint, const object *, const char *, void *, void *) = find_opencl("clBuildProgram");
    const char *given = options == NULL ? "" : options, *added = getenv(OPTIONS) == NULL ? "" : getenv(OPTIONS);
    char *both = malloc(strlen(given) + strlen(added) + 2);
    sprintf(both, "%s %s", given, added);
    cl_int error = own(program, number, devices, both, notify, data);
    free(both);
    pthread_mutex_lock(&lock);
    keep(program, error == 0);
    pthread_mutex_unlock(&lock);
    return error;
}
