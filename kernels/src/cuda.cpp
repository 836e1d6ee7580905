#include "factory.h"

#include "openmm/cuda/CudaContext.h"
#include "openmm/cuda/CudaKernelFactory.h"
#include "openmm/cuda/CudaPlatform.h"

extern "C" OPENMM_EXPORT void registerPlatforms() {
}

extern "C" OPENMM_EXPORT void registerKernelFactories() {
    OpenMMSIER::registerFactory<OpenMM::CudaKernelFactory, OpenMM::CudaPlatform::PlatformData>("CUDA");
}
