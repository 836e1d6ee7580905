/* Counts the commands that a program sends to OpenCL, and passes them on.
 *
 * The linker finds the functions of a preloaded library before those of OpenCL. Those that send commands or wait for
 * them are here under their own names. Each notes its command, calls OpenCL's function, and adds up the processor
 * time of the calling thread there. Functions of OpenMM by which a step computes forces are here too, and those that
 * make steps: so the time is known that the host spends on a step beside forces and OpenCL. `shim.py` compiles this
 * file and calls the functions at its end.
 */
#include "opencl.h"
#include <time.h>

#define CL_KERNEL_FUNCTION_NAME 0x1190
#define CL_QUEUE_CONTEXT 0x1090
#define CL_COMPLETE 0

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

/* Number of functions here that the calling thread is in, when it entered the first one, the time in all of them, and
 * that of steps outside of them. */
static __thread int depth;
static __thread double entered, elsewhere, in_steps;

/* Whether commands are forgotten, and an event that is complete. */
static int drops_commands;
static object completed;

static double time_by(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static void enter(void)
{
    if (depth++ == 0)
        entered = time_by(CLOCK_MONOTONIC);
}

static void leave(void)
{
    if (--depth == 0)
        elsewhere += time_by(CLOCK_MONOTONIC) - entered;
}

/* Whether a command is forgotten. Its event is complete. */
static int is_dropped(object *event)
{
    if (!drops_commands)
        return 0;
    if (event != NULL) {
        ((cl_int (*)(object)) find_opencl("clRetainEvent"))(completed);
        *event = completed;
    }
    return 1;
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
        own = (type (*) parameters) find_opencl(#name);                                                                \
    enter();                                                                                                           \
    double start = time_by(CLOCK_THREAD_CPUTIME_ID);                                                                   \
    type result = own arguments;                                                                                       \
    seconds += time_by(CLOCK_THREAD_CPUTIME_ID) - start;                                                               \
    leave();                                                                                                           \
    return result

cl_int clEnqueueNDRangeKernel(object queue, object kernel, cl_uint dimensions, const size_t *offset,
                              const size_t *global, const size_t *local, cl_uint n, const object *after, object *event)
{
    if (is_dropped(event))
        return 0;
    last_queue = queue;
    if (is_counting) {
        static cl_int (*information)(object, cl_uint, size_t, void *, size_t *);
        if (information == NULL)
            information = (cl_int (*)(object, cl_uint, size_t, void *, size_t *)) find_opencl("clGetKernelInfo");
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
    if (!is_blocking && is_dropped(event))
        return 0;
    note("read", "", is_blocking != 0, bytes);
    PASS_ON(cl_int, clEnqueueReadBuffer,
            (object, object, cl_bool, size_t, size_t, void *, cl_uint, const object *, object *),
            (queue, buffer, is_blocking, offset, bytes, to, n, after, event));
}

cl_int clEnqueueWriteBuffer(object queue, object buffer, cl_bool is_blocking, size_t offset, size_t bytes,
                            const void *from, cl_uint n, const object *after, object *event)
{
    if (is_dropped(event))
        return 0;
    note("write", "", is_blocking != 0, bytes);
    PASS_ON(cl_int, clEnqueueWriteBuffer,
            (object, object, cl_bool, size_t, size_t, const void *, cl_uint, const object *, object *),
            (queue, buffer, is_blocking, offset, bytes, from, n, after, event));
}

cl_int clEnqueueCopyBuffer(object queue, object from, object to, size_t from_offset, size_t to_offset, size_t bytes,
                           cl_uint n, const object *after, object *event)
{
    if (is_dropped(event))
        return 0;
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

/* Each launch calls these too. */

cl_int clSetKernelArg(object kernel, cl_uint index, size_t size, const void *value)
{
    if (is_dropped(NULL))
        return 0;
    PASS_ON(cl_int, clSetKernelArg, (object, cl_uint, size_t, const void *), (kernel, index, size, value));
}

cl_int clRetainCommandQueue(object queue)
{
    if (is_dropped(NULL))
        return 0;
    PASS_ON(cl_int, clRetainCommandQueue, (object), (queue));
}

cl_int clReleaseCommandQueue(object queue)
{
    if (is_dropped(NULL))
        return 0;
    PASS_ON(cl_int, clReleaseCommandQueue, (object), (queue));
}

/* --- OpenMM's functions, by their names for the linker --- */

/* A function of the type that comes first, which calls the one that it stands before. */
#define STANDS_BEFORE(type, name, symbol, library, parameters, arguments)                                              \
    type name parameters __asm__(symbol);                                                                              \
    type name parameters                                                                                               \
    {                                                                                                                  \
        static type (*own) parameters;                                                                                 \
        enter();                                                                                                       \
        if (own == NULL)                                                                                               \
            own = (type (*) parameters) find(symbol, library);                                                         \
        type result = own arguments;                                                                                   \
        leave();                                                                                                       \
        return result;                                                                                                 \
    }

STANDS_BEFORE(double, compute_forces, "_ZN6OpenMM11ContextImpl19calcForcesAndEnergyEbbi", "libOpenMM.so",
              (object context, _Bool forces, _Bool energy, int groups), (context, forces, energy, groups))
STANDS_BEFORE(_Bool, update_context, "_ZN6OpenMM11ContextImpl18updateContextStateEv", "libOpenMM.so",
              (object context), (context))

/* A function that makes steps. */
#define MAKES_STEPS(name, symbol)                                                                                      \
    void name(object integrator, int steps) __asm__(symbol);                                                           \
    void name(object integrator, int steps)                                                                            \
    {                                                                                                                  \
        static void (*own)(object, int);                                                                               \
        if (own == NULL)                                                                                               \
            own = (void (*)(object, int)) find(symbol, "libOpenMM.so");                                                \
        double start = time_by(CLOCK_MONOTONIC), before = elsewhere;                                                   \
        own(integrator, steps);                                                                                        \
        in_steps += time_by(CLOCK_MONOTONIC) - start - (elsewhere - before);                                           \
    }

MAKES_STEPS(step_custom, "_ZN6OpenMM16CustomIntegrator4stepEi")
MAKES_STEPS(step_middle, "_ZN6OpenMM24LangevinMiddleIntegrator4stepEi")

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

/* Time of steps in which the calling thread was in none of the functions above. */
double seconds_in_steps(void)
{
    return in_steps;
}

/* Forget commands from now on, so that the host waits for none: the last queue was of the Context. */
void drop_commands(void)
{
    object context;
    cl_int error;
    cl_int (*information)(object, cl_uint, size_t, void *, size_t *)
        = (cl_int (*)(object, cl_uint, size_t, void *, size_t *)) find_opencl("clGetCommandQueueInfo");
    information(last_queue, CL_QUEUE_CONTEXT, sizeof context, &context, NULL);
    completed = ((object (*)(object, cl_int *)) find_opencl("clCreateUserEvent"))(context, &error);
    ((cl_int (*)(object, cl_int)) find_opencl("clSetUserEventStatus"))(completed, CL_COMPLETE);
    drops_commands = 1;
}

/* Wait until everything that was sent is done. This is not counted. */
void finish_commands(void)
{
    static cl_int (*own)(object);
    if (own == NULL)
        own = (cl_int (*)(object)) find_opencl("clFinish");
    if (last_queue != NULL)
        own(last_queue);
}
