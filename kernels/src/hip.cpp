#include "factory.h"

#include "openmm/hip/HipContext.h"
#include "openmm/hip/HipPlatform.h"

extern "C" OPENMM_EXPORT void registerPlatforms() {
}

extern "C" OPENMM_EXPORT void registerKernelFactories() {
    OpenMMSIER::registerFactory<OpenMM::HipPlatform::PlatformData>("HIP");
}
