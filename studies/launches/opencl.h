/* What libraries share that stand before OpenCL: its types, and its own functions. */
#ifndef STUDIES_OPENCL_H
#define STUDIES_OPENCL_H
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* As in OpenCL's headers, which need not be installed. Contexts, programs, queues, kernels and buffers are pointers. */
typedef int32_t cl_int;
typedef uint32_t cl_uint;
typedef uint32_t cl_bool;
typedef uint64_t cl_map_flags;
typedef void *object;

/* The function of a name of a library. */
static inline void *find(const char *name, const char *file)
{
    void *library = dlopen(file, RTLD_NOW);
    void *found = library == NULL ? NULL : dlsym(library, name);
    if (found == NULL) {
        fprintf(stderr, "%s has no %s\n", file, name);
        abort();
    }
    return found;
}

static inline void *find_opencl(const char *name)
{
    return find(name, "libOpenCL.so.1");
}

#endif
