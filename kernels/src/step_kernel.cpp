#include "step_kernel.h"

#include "openmm/CustomIntegrator.h"
#include "openmm/OpenMMException.h"
#include "openmm/common/ComputeForceInfo.h"
#include "openmm/common/ContextSelector.h"
#include "openmm/common/IntegrationUtilities.h"
#include "openmm/internal/ContextImpl.h"

using namespace OpenMM;
using namespace std;

namespace OpenMMSIER {

namespace {

/** Units in one kJ/mol of totals. */
const double FIXED_POINT = 4294967296.0;

/** Steps after which commands are sent on, so that other users of the device do not wait. */
const int STEPS_IN_QUEUE = 100;

/** Number of transfers to the device of which the last one is waited for, and with it all before. */
const size_t MOST_SENT = 100;

/** Keeps the atoms of bodies together when atoms are reordered. */
class BodyInfo : public ComputeForceInfo {
public:
    explicit BodyInfo(shared_ptr<Program> program) : program(program) {
    }
    int getNumParticleGroups() override {
        return program->bodies.size();
    }
    void getParticlesInGroup(int index, vector<int>& particles) override {
        particles = program->bodies[index].atoms;
    }
    bool areGroupsIdentical(int first, int second) override {
        return program->bodies[first].kind == program->bodies[second].kind;
    }

private:
    shared_ptr<Program> program;
};

}  // namespace

StepKernel::StepKernel(string name, const Platform& platform, ContextImpl& context, ComputeContext& cc, Kernel own)
    : IntegrateCustomStepKernel(name, platform), context(context), cc(cc), ownKernel(own) {
}

IntegrateCustomStepKernel& StepKernel::own() const {
    return ownKernel.getAs<IntegrateCustomStepKernel>();
}

void StepKernel::getGlobalVariables(ContextImpl& context, vector<double>& values) const {
    own().getGlobalVariables(context, values);
}

void StepKernel::setGlobalVariables(ContextImpl& context, const vector<double>& values) {
    own().setGlobalVariables(context, values);
}

void StepKernel::getPerDofVariable(ContextImpl& context, int variable, vector<Vec3>& values) const {
    own().getPerDofVariable(context, variable, values);
}

void StepKernel::setPerDofVariable(ContextImpl& context, int variable, const vector<Vec3>& values) {
    own().setPerDofVariable(context, variable, values);
}

StepKernel::~StepKernel() {
    release();
}

void StepKernel::release() {
    if (program == nullptr)
        return;
    if (program->kernel == this)
        program->kernel = nullptr;
    program = nullptr;
    ContextSelector selector(cc);
    kernels.clear();
    randomIndices.clear();
    arrays.clear();
}

void StepKernel::initialize(const System& system, const CustomIntegrator& integrator) {
    program = findProgram(&integrator);
    // OpenMM's kernel lets it find molecules, which are those that it moves together from then on.
    if (program != nullptr && !program->bodies.empty())
        cc.addForce(new BodyInfo(program));
    own().initialize(system, integrator);
    if (program == nullptr)
        return;
    ContextSelector selector(cc);
    makeArrays();
    program->areScalarsNew = true;
    program->kernel = this;
}

void StepKernel::makeArrays() {
    const int size = cc.getUseDoublePrecision() || cc.getUseMixedPrecision() ? sizeof(double) : sizeof(float);
    for (auto& table : program->integers) {
        arrays[table.name].initialize<int>(cc, table.values.size(), table.name);
        arrays[table.name].upload(table.values);
    }
    for (auto& table : program->numbers) {
        arrays[table.name].initialize(cc, table.values.size(), size, table.name);
        arrays[table.name].upload(table.values, true);
    }
    for (auto& total : program->totals) {
        arrays[total.name].initialize<long long>(cc, total.size, total.name);
        cc.clearBuffer(arrays[total.name]);
    }
    scalars.initialize(cc, max<size_t>(1, program->scalars.size()), size, "scalars");
}

void StepKernel::makeKernels() {
    map<string, string> defines;
    if (!cc.getUseMixedPrecision() && !cc.getUseDoublePrecision())
        defines["USE_SINGLE_PRECISION"] = "1";
    defines["PADDED_NUM_ATOMS"] = cc.intToString(cc.getPaddedNumAtoms());
    vector<ComputeProgram> compiled;
    for (auto& source : program->sources)
        compiled.push_back(cc.compileProgram(source, defines));
    for (auto& entry : program->kernels) {
        ComputeKernel kernel = compiled[entry.source]->createKernel(entry.name);
        int place = 0;
        int randomIndex = -1;
        for (auto& name : entry.arguments) {
            if (name == "posqCorrection" && !cc.getUseMixedPrecision())
                continue;
            if (addArgument(kernel, name))
                randomIndex = place;
            place++;
        }
        if (randomIndex >= 0)
            kernel->setArg(randomIndex, 0);
        kernels.push_back(kernel);
        randomIndices.push_back(randomIndex);
    }
}

bool StepKernel::addArgument(ComputeKernel& kernel, const string& name) {
    if (name == "randomIndex") {
        kernel->addArg();
        return true;
    }
    if (name == "posq")
        kernel->addArg(cc.getPosq());
    else if (name == "posqCorrection")
        kernel->addArg(cc.getPosqCorrection());
    else if (name == "velm")
        kernel->addArg(cc.getVelm());
    else if (name == "force")
        kernel->addArg(cc.getLongForceBuffer());
    else if (name == "random")
        kernel->addArg(cc.getIntegrationUtilities().getRandom());
    else if (name == "scalars")
        kernel->addArg(scalars);
    else if (arrays.count(name))
        kernel->addArg(arrays[name]);
    else
        throw OpenMMException("A SIER program has no array '" + name + "'");
    return false;
}

void StepKernel::uploadScalars() {
    if (!program->areScalarsNew || program->scalars.empty())
        return;
    if ((int) program->scalars.size() != (int) scalars.getSize())
        throw OpenMMException("A SIER program was given another number of scalars than it was made with");
    sendNumbers(scalars, program->scalars.data());
    program->areScalarsNew = false;
}

void StepKernel::send(ArrayInterface& array, const void* bytes) {
    const char* start = static_cast<const char*>(bytes);
    sent.emplace_back(start, start + array.getSize()*array.getElementSize());
    const bool waits = sent.size() == MOST_SENT;
    array.upload(sent.back().data(), waits);
    if (waits)
        sent.clear();
}

void StepKernel::sendNumbers(ArrayInterface& array, const double* values) {
    if (array.getElementSize() == sizeof(double)) {
        send(array, values);
        return;
    }
    const vector<float> rounded(values, values + array.getSize());
    send(array, rounded.data());
}

void StepKernel::prepare() {
    // Not in `initialize`: OpenMM has not made all its arrays by then.
    if (kernels.empty())
        makeKernels();
    if (order.empty())
        order = cc.getAtomIndex();
    uploadScalars();
    integrationGroups = context.getIntegrator().getIntegrationForceGroups();
    knownGroups = context.getLastForceGroups();
}

void StepKernel::execute(ContextImpl& context, CustomIntegrator& integrator, bool& forcesAreValid) {
    if (program == nullptr) {
        own().execute(context, integrator, forcesAreValid);
        return;
    }
    ContextSelector selector(cc);
    prepare();
    areForcesKnown = forcesAreValid && !hasMoved;
    execute(0);
    hasMoved = false;
    cc.setTime(cc.getTime() + program->step);
    cc.setStepCount(cc.getStepCount() + 1);
    reorder();
    forcesAreValid = areForcesKnown;
    if (cc.getStepCount() % STEPS_IN_QUEUE == 0)
        cc.flushQueue();
}

void StepKernel::execute(int block) {
    for (auto& command : program->blocks[block])
        run(command);
}

double StepKernel::runBlock(int block, int times, bool areForcesKnown) {
    ContextSelector selector(cc);
    prepare();
    this->areForcesKnown = this->areForcesKnown && areForcesKnown;
    energy = 0;
    for (int i = 0; i < times; i++)
        execute(block);
    return energy;
}

void StepKernel::run(const Command& command) {
    switch (command.kind) {
        case UPDATE:
            if (context.updateContextState())
                areForcesKnown = false;
            break;
        case FORCES:
            calculate(integrationGroups & command.first, false);
            break;
        case FORCES_AND_ENERGY:
            calculate(integrationGroups & command.first, true);
            break;
        case LAUNCH:
            launch(command.first);
            break;
        case SITES:
            cc.getIntegrationUtilities().computeVirtualSites();
            break;
        case REORDER:
            // OpenMM counts its calls, after some of which it does so.
            cc.setStepsSinceReorder(cc.getStepsSinceReorder() + command.first - 1);
            reorder();
            break;
        case RESTORED:
            areForcesKnown = true;
            knownGroups = integrationGroups & command.first;
            break;
        default:
            throw OpenMMException("A SIER program has an unknown command");
    }
}

void StepKernel::reorder() {
    cc.reorderAtoms();
    if (!cc.getAtomsWereReordered())
        return;
    areForcesKnown = false;
    order = cc.getAtomIndex();
}

void StepKernel::calculate(int groups, bool wantsEnergy) {
    if (!wantsEnergy && areForcesKnown && knownGroups == groups)
        return;
    const double found = context.calcForcesAndEnergy(true, wantsEnergy, groups);
    energy += wantsEnergy ? found : 0;
    areForcesKnown = true;
    knownGroups = groups;
}

void StepKernel::launch(int number) {
    const KernelEntry& entry = program->kernels[number];
    ComputeKernel& kernel = kernels[number];
    if (entry.noise > 0) {
        const int index = cc.getIntegrationUtilities().prepareRandomNumbers(entry.noise);
        kernel->setArg(randomIndices[number], index);
    }
    kernel->execute(entry.threads, entry.blockSize);
    if (entry.movesAtoms) {
        areForcesKnown = false;
        hasMoved = true;
    }
}

double StepKernel::computeKineticEnergy(ContextImpl& context, CustomIntegrator& integrator, bool& forcesAreValid) {
    if (program == nullptr)
        return own().computeKineticEnergy(context, integrator, forcesAreValid);
    ContextSelector selector(cc);
    return cc.getIntegrationUtilities().computeKineticEnergy(0);
}

void StepKernel::writeNumbers(const string& name, const double* values) {
    ContextSelector selector(cc);
    sendNumbers(arrays.at(name), values);
}

void StepKernel::clearTotals(const string& name) {
    ContextSelector selector(cc);
    ArrayInterface& array = arrays.at(name);
    const vector<long long> zeros(array.getSize(), 0);
    send(array, zeros.data());
}

vector<long long> StepKernel::readTotals(const string& name) {
    ContextSelector selector(cc);
    vector<long long> totals;
    arrays.at(name).download(totals);
    sent.clear();
    return totals;
}

void StepKernel::readVectors(const string& name, double* values) {
    if (order.empty())
        return;
    ContextSelector selector(cc);
    vector<double> vectors;
    arrays.at(name).download(vectors, true);
    for (int i = 0; i < cc.getNumAtoms(); i++)
        for (int x = 0; x < 3; x++)
            values[3 * order[i] + x] = vectors[4 * i + x];
}

double StepKernel::takeTotal(const string& name) {
    double sum = 0;
    for (long long part : readTotals(name))
        sum += part / FIXED_POINT;
    ContextSelector selector(cc);
    cc.clearBuffer(arrays.at(name));
    return sum;
}

}  // namespace OpenMMSIER
