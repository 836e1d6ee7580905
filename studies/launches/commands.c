/* Counts the commands that a program sends to OpenCL, and passes them on.
 *
 * The linker finds the functions of a preloaded library before those of OpenCL. Those that send commands or wait for
 * them are here under their own names. Each notes its command, calls OpenCL's function, and adds up the processor
 * time of the calling thread there. `shim.py` compiles this file and calls the functions at its end.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* As in OpenCL's headers, which need not be installed. Queues, kernels, buffers and events are pointers. */
typedef int32_t cl_int;
typedef uint32_t cl_uint;
typedef uint32_t cl_bool;
typedef uint64_t cl_map_flags;
typedef void *object;
#define CL_KERNEL_FUNCTION_NAME 0x1190

/* Commands that are alike in everything but their sizes; `struct command` of shim.py. */
struct command {
    char kind[16];
    char kernel[112];
    int is_blocking;
    long number;
    long bytes;
};

#define MOST_COMMANDS 1000

static struct command commands[MOST_COMMANDS];
static int n_commands;
static int is_counting;
static object last_queue;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static __thread double seconds;

/* OpenCL's own function of a name. */
static void *find(const char *name)
{
    static void *library;
    if (library == NULL)
        library = dlopen("libOpenCL.so.1", RTLD_NOW);
    void *found = library == NULL ? NULL : dlsym(library, name);
    if (found == NULL) {
        fprintf(stderr, "libOpenCL.so.1 has no %s\n", name);
        abort();
    }
    return found;
}

static double clock_time(void)
{
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static void note(const char *kind, const char *kernel, int is_blocking, size_t bytes)
{
    if (!is_counting)
        return;
    pthread_mutex_lock(&lock);
    int i = 0;
    while (i < n_commands && (strcmp(commands[i].kind, kind) != 0 || strcmp(commands[i].kernel, kernel) != 0
                              || commands[i].is_blocking != is_blocking))
        i++;
    if (i == MOST_COMMANDS) {
        fprintf(stderr, "there are more than %d kinds of OpenCL commands\n", MOST_COMMANDS);
        abort();
    }
    if (i == n_commands) {
        snprintf(commands[i].kind, sizeof commands[i].kind, "%s", kind);
        snprintf(commands[i].kernel, sizeof commands[i].kernel, "%s", kernel);
        commands[i].is_blocking = is_blocking;
        commands[i].number = commands[i].bytes = 0;
        n_commands++;
    }
    commands[i].number++;
    commands[i].bytes += bytes;
    pthread_mutex_unlock(&lock);
}

/* The rest of a function of the type that comes first, which gives what OpenCL's function of the same name gives. */
#define PASS_ON(type, name, parameters, arguments)                                                                     \
    static type (*own) parameters;                                                                                     \
    if (own == NULL)                                                                                                   \
        own = (type (*) parameters) find(#name);                                                                       \
    double start = clock_time();                                                                                   \
    type result = own arguments;                                                                                       \
    seconds += clock_time() - start;                                                                               \
    return result

cl_int clEnqueueNDRangeKernel(object queue, object kernel, cl_uint dimensions, const size_t *offset,
                              const size_t *global, const size_t *local, cl_uint n, const object *after, object *event)
{
    last_queue = queue;
    if (is_counting) {
        static cl_int (*information)(object, cl_uint, size_t, void *, size_t *);
        if (information == NULL)
            information = (cl_int (*)(object, cl_uint, size_t, void *, size_t *)) find("clGetKernelInfo");
        char name[112] = "";
        if (information(kernel, CL_KERNEL_FUNCTION_NAME, sizeof name, name, NULL) != 0)
            strcpy(name, "unknown");
        note("kernel", name, 0, 0);
    }
    PASS_ON(cl_int, clEnqueueNDRangeKernel,
            (object, object, cl_uint, const size_t *, const size_t *, const size_t *, cl_uint, const object *, object *),
            (queue, kernel, dimensions, offset, global, local, n, after, event));
}

cl_int clEnqueueReadBuffer(object queue, object buffer, cl_bool is_blocking, size_t offset, size_t bytes, void *to,
                           cl_uint n, const object *after, object *event)
{
    note("read", "", is_blocking != 0, bytes);
    PASS_ON(cl_int, clEnqueueReadBuffer,
            (object, object, cl_bool, size_t, size_t, void *, cl_uint, const object *, object *),
            (queue, buffer, is_blocking, offset, bytes, to, n, after, event));
}

cl_int clEnqueueWriteBuffer(object queue, object buffer, cl_bool is_blocking, size_t offset, size_t bytes,
                            const void *from, cl_uint n, const object *after, object *event)
{
    note("write", "", is_blocking != 0, bytes);
    PASS_ON(cl_int, clEnqueueWriteBuffer,
            (object, object, cl_bool, size_t, size_t, const void *, cl_uint, const object *, object *),
            (queue, buffer, is_blocking, offset, bytes, from, n, after, event));
}

cl_int clEnqueueCopyBuffer(object queue, object from, object to, size_t from_offset, size_t to_offset, size_t bytes,
                           cl_uint n, const object *after, object *event)
{
    note("copy", "", 0, bytes);
    PASS_ON(cl_int, clEnqueueCopyBuffer,
            (object, object, object, size_t, size_t, size_t, cl_uint, const object *, object *),
            (queue, from, to, from_offset, to_offset, bytes, n, after, event));
}

void *clEnqueueMapBuffer(object queue, object buffer, cl_bool is_blocking, cl_map_flags flags, size_t offset,
                         size_t bytes, cl_uint n, const object *after, object *event, cl_int *error)
{
    note("map", "", is_blocking != 0, bytes);
    PASS_ON(void *, clEnqueueMapBuffer,
            (object, object, cl_bool, cl_map_flags, size_t, size_t, cl_uint, const object *, object *, cl_int *),
            (queue, buffer, is_blocking, flags, offset, bytes, n, after, event, error));
}

cl_int clFinish(object queue)
{
    note("wait", "", 1, 0);
    PASS_ON(cl_int, clFinish, (object), (queue));
}

cl_int clWaitForEvents(cl_uint n, const object *events)
{
    note("wait", "", 1, 0);
    PASS_ON(cl_int, clWaitForEvents, (cl_uint, const object *), (n, events));
}

/* --- for shim.py --- */

/* Forget what was counted, and count from now on. */
void start_counting(void)
{
    n_commands = 0;
    is_counting = 1;
}

/* Count no longer, and give what was counted. */
const struct command *stop_counting(int *number)
{
    is_counting = 0;
    *number = n_commands;
    return commands;
}

/* Time that the calling thread has spent in the functions above. */
double seconds_in_opencl(void)
{
    return seconds;
}

/* Wait until everything that was sent is done. This is not counted. */
void finish_commands(void)
{
    static cl_int (*own)(object);
    if (own == NULL)
        own = (cl_int (*)(object)) find("clFinish");
    if (last_queue != NULL)
        own(last_queue);
}
