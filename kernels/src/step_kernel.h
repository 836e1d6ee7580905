#ifndef OPENMM_SIER_STEP_KERNEL_H_
#define OPENMM_SIER_STEP_KERNEL_H_

#include "program.h"

#include "openmm/common/ComputeArray.h"
#include "openmm/common/ComputeContext.h"
#include "openmm/Kernel.h"
#include "openmm/common/ComputeKernel.h"
#include "openmm/kernels.h"

#include <list>
#include <map>

namespace OpenMMSIER {

/**
 * Executes the steps of CustomIntegrators: of those that have a Program by its commands, and of all others by OpenMM's
 * kernel, which also has the variables.
 */
class StepKernel : public OpenMM::IntegrateCustomStepKernel {
public:
    /** `own` is OpenMM's kernel for the same Context. */
    StepKernel(std::string name, const OpenMM::Platform& platform, OpenMM::ContextImpl& context,
               OpenMM::ComputeContext& cc, OpenMM::Kernel own);
    ~StepKernel();
    void initialize(const OpenMM::System& system, const OpenMM::CustomIntegrator& integrator) override;
    void execute(OpenMM::ContextImpl& context, OpenMM::CustomIntegrator& integrator, bool& forcesAreValid) override;
    double computeKineticEnergy(OpenMM::ContextImpl& context, OpenMM::CustomIntegrator& integrator,
                                bool& forcesAreValid) override;
    void getGlobalVariables(OpenMM::ContextImpl& context, std::vector<double>& values) const override;
    void setGlobalVariables(OpenMM::ContextImpl& context, const std::vector<double>& values) override;
    void getPerDofVariable(OpenMM::ContextImpl& context, int variable, std::vector<OpenMM::Vec3>& values) const override;
    void setPerDofVariable(OpenMM::ContextImpl& context, int variable, const std::vector<OpenMM::Vec3>& values) override;

    /** Leave the program, and all that was made for it. */
    void release();

    /**
     * Execute a block of commands several times, and return the sum of the energies that it asks for.
     *
     * `areForcesKnown` tells whether nobody has changed the Context since the last block or step.
     */
    double runBlock(int block, int times, bool areForcesKnown);

    /** Write a table of numbers, without waiting for the device. */
    void writeNumbers(const std::string& name, const double* values);

    /** Set sums to zero, without waiting for the device; read them. */
    void clearTotals(const std::string& name);
    std::vector<long long> readTotals(const std::string& name);

    /** Read vectors of atoms, in the order that atoms had in the last step. */
    void readVectors(const std::string& name, double* values);

    /** Return a sum of the program, and set it to zero. */
    double takeTotal(const std::string& name);

private:
    /** Return OpenMM's kernel. */
    OpenMM::IntegrateCustomStepKernel& own() const;
    void makeArrays();
    void makeKernels();
    /** Add an argument, and return whether it is the index of the random vectors. */
    bool addArgument(OpenMM::ComputeKernel& kernel, const std::string& name);
    void uploadScalars();
    /** Send all of an array, the bytes of its elements, without waiting for the device. */
    void send(OpenMM::ArrayInterface& array, const void* bytes);
    void sendNumbers(OpenMM::ArrayInterface& array, const double* values);
    void execute(int block);
    /** Make what the first block or step needs. */
    void prepare();
    void run(const Command& command);
    void reorder();
    void calculate(int groups, bool wantsEnergy);
    void launch(int number);

    OpenMM::ContextImpl& context;
    OpenMM::ComputeContext& cc;
    mutable OpenMM::Kernel ownKernel;
    std::shared_ptr<Program> program;
    std::map<std::string, OpenMM::ComputeArray> arrays;
    OpenMM::ComputeArray scalars;
    std::vector<OpenMM::ComputeKernel> kernels;
    /** For each kernel, the place of the index of its random vectors among its arguments. */
    std::vector<int> randomIndices;
    /** What was sent, which OpenMM may not have read yet, since the device was last waited for. */
    std::list<std::vector<char>> sent;
    /** Numbers of the atoms in the order that they had in the last step. */
    std::vector<int> order;
    int integrationGroups = -1;
    /** Whether the forces of these groups are known where the atoms are. */
    bool areForcesKnown = false;
    int knownGroups = 0;
    /** Whether a block has moved atoms since the last step. */
    bool hasMoved = false;
    /** Sum of the energies of a run. */
    double energy = 0.0;
};

}  // namespace OpenMMSIER

#endif
