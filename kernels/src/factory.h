#ifndef OPENMM_SIER_FACTORY_H_
#define OPENMM_SIER_FACTORY_H_

#include "step_kernel.h"

#include "openmm/KernelFactory.h"
#include "openmm/Platform.h"
#include "openmm/PluginInitializer.h"
#include "openmm/internal/ContextImpl.h"

namespace OpenMMSIER {

/** Makes the kernels that execute CustomIntegrators on a platform with such a factory and data. */
template <class PlatformFactory, class PlatformData>
class Factory : public OpenMM::KernelFactory {
public:
    OpenMM::KernelImpl* createKernelImpl(std::string name, const OpenMM::Platform& platform,
                                         OpenMM::ContextImpl& context) const override {
        PlatformData* data = reinterpret_cast<PlatformData*>(context.getPlatformData());
        // Not a base class: how large its members are depends on how OpenMM was compiled.
        OpenMM::Kernel own(PlatformFactory().createKernelImpl(name, platform, context));
        return new StepKernel(name, platform, context, *data->contexts[0], own);
    }
};

/** Let a factory make these kernels on the platform of a name from now on. */
template <class PlatformFactory, class PlatformData>
void registerFactory(const std::string& platformName) {
    for (int i = 0; i < OpenMM::Platform::getNumPlatforms(); i++) {
        OpenMM::Platform& platform = OpenMM::Platform::getPlatform(i);
        if (platform.getName() == platformName)
            platform.registerKernelFactory(OpenMM::IntegrateCustomStepKernel::Name(), new Factory<PlatformFactory, PlatformData>());
    }
}

}  // namespace OpenMMSIER

#endif
