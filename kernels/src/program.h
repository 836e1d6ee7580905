#ifndef OPENMM_SIER_PROGRAM_H_
#define OPENMM_SIER_PROGRAM_H_

#include <memory>
#include <mutex>
#include <string>
#include <vector>

namespace OpenMMSIER {

class StepKernel;

/** Integers or numbers that kernels read. */
template <class T>
struct Table {
    std::string name;
    std::vector<T> values;
};

/** Sums that kernels add to, in units of 2^-32, one for each thread. */
struct Totals {
    std::string name;
    int size;
};

/**
 * A kernel, with the names of its arguments in order. These are "posq", "posqCorrection" (left out where there is
 * none), "velm", "force", "random", "randomIndex", "scalars", and names of tables and totals.
 */
struct KernelEntry {
    std::string name;
    /** The number of its source. */
    int source;
    std::vector<std::string> arguments;
    int threads;
    int blockSize;
    /** Number of random vectors of four that each launch uses up. */
    int noise;
    /** Whether it changes positions. */
    bool movesAtoms;
};

/** What a command does; values that callers in Python know, too. */
enum CommandKind {
    /** OpenMM's barostats, thermostats and removers of the motion of the centre of mass act. */
    UPDATE = 0,
    /** The forces of the integration force groups in the bit mask `first` become known. */
    FORCES = 1,
    /** The kernel with the number `first` is launched. */
    LAUNCH = 2,
    /** Virtual sites follow their atoms. */
    SITES = 3,
    /** The forces and the energy of these groups become known. The energy is added to that of the run. */
    FORCES_AND_ENERGY = 4,
    /** OpenMM may put atoms that are near each other in space beside each other in memory, as after `first` steps. */
    REORDER = 5,
    /** A kernel has brought back the forces of the groups `first` where the atoms are. */
    RESTORED = 6
};

struct Command {
    int kind;
    int first;
};

/** Atoms that must stay together when atoms are reordered. Those of one kind may change places. */
struct Body {
    int kind;
    std::vector<int> atoms;
};

/** A step of an integrator, the first block of commands, and other blocks, which are executed one by one. */
struct Program {
    std::vector<std::string> sources;
    std::vector<Table<int>> integers;
    std::vector<Table<double>> numbers;
    std::vector<Totals> totals;
    std::vector<KernelEntry> kernels;
    std::vector<std::vector<Command>> blocks;
    std::vector<Body> bodies;
    /** Time of a step, ps. */
    double step = 0.0;
    std::vector<double> scalars;
    bool areScalarsNew = true;
    /** Executes this; there is none before the Context is created. */
    StepKernel* kernel = nullptr;
};

/** Return the program of an integrator, by its address; null without one. */
std::shared_ptr<Program> findProgram(const void* integrator);

}  // namespace OpenMMSIER

#endif
