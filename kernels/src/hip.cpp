#include "factory.h"

#include "openmm/hip/HipContext.h"
#include "openmm/hip/HipKernelFactory.h"
#include "openmm/hip/HipPlatform.h"

extern "C" OPENMM_EXPORT void registerPlatforms() {
}

extern "C" OPENMM_EXPORT void registerKernelFactories() {
    OpenMMSIER::registerFactory<OpenMM::HipKernelFactory, OpenMM::HipPlatform::PlatformData>("HIP");
}
