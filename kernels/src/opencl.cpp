// OpenMM's opencl.hpp has a later form of these extensions than older C headers, and nothing here uses them.
#ifdef __APPLE__
#include <OpenCL/opencl.h>
#else
#include <CL/opencl.h>
#endif
#undef cl_khr_command_buffer
#undef cl_khr_command_buffer_mutable_dispatch

#include "factory.h"

#include "openmm/opencl/OpenCLContext.h"
#include "openmm/opencl/OpenCLKernelFactory.h"
#include "openmm/opencl/OpenCLPlatform.h"

extern "C" OPENMM_EXPORT void registerPlatforms() {
}

extern "C" OPENMM_EXPORT void registerKernelFactories() {
    OpenMMSIER::registerFactory<OpenMM::OpenCLKernelFactory, OpenMM::OpenCLPlatform::PlatformData>("OpenCL");
}
