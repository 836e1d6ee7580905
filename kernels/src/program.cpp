/* Programs of integrators, and the functions by which Python makes them. */

#include "program.h"

#include "step_kernel.h"

#include <algorithm>
#include <map>
#include <sstream>

using namespace std;

namespace OpenMMSIER {

namespace {

mutex access;

map<const void*, shared_ptr<Program>>& programs() {
    static map<const void*, shared_ptr<Program>> all;
    return all;
}

vector<string> words(const char* text) {
    istringstream stream(text);
    vector<string> found;
    string word;
    while (stream >> word)
        found.push_back(word);
    return found;
}

}  // namespace

shared_ptr<Program> findProgram(const void* integrator) {
    lock_guard<mutex> guard(access);
    auto found = programs().find(integrator);
    return found == programs().end() ? nullptr : found->second;
}

}  // namespace OpenMMSIER

using namespace OpenMMSIER;

extern "C" {

Program* sier_new_program() {
    return new Program();
}

void sier_add_source(Program* program, const char* source) {
    program->sources.push_back(source);
}

void sier_add_integers(Program* program, const char* name, const int* values, int size) {
    program->integers.push_back({name, vector<int>(values, values + size)});
}

void sier_add_numbers(Program* program, const char* name, const double* values, int size) {
    program->numbers.push_back({name, vector<double>(values, values + size)});
}

void sier_add_totals(Program* program, const char* name, int size) {
    program->totals.push_back({name, size});
}

/** Add a kernel; `arguments` are names with spaces between them. */
void sier_add_kernel(Program* program, const char* name, int source, const char* arguments, int threads, int blockSize,
                     int noise, int movesAtoms) {
    program->kernels.push_back({name, source, words(arguments), threads, blockSize, noise, movesAtoms != 0});
}

/** Begin another block of commands. */
void sier_add_block(Program* program) {
    program->blocks.emplace_back();
}

/** Add a command to the last block. */
void sier_add_command(Program* program, int kind, int first) {
    program->blocks.back().push_back({kind, first});
}

/** Add bodies of one kind, each of `size` atoms. */
void sier_add_bodies(Program* program, int kind, const int* atoms, int number, int size) {
    for (int i = 0; i < number; i++)
        program->bodies.push_back({kind, vector<int>(atoms + i * size, atoms + (i + 1) * size)});
}

/** Give an integrator a program, which it owns from then on. */
void sier_assign(const void* integrator, Program* program) {
    shared_ptr<Program> owned(program);
    lock_guard<mutex> guard(access);
    programs()[integrator] = owned;
}

/**
 * Take a program from an integrator, unless it has another one by now, as an integrator that was made at the same
 * address. OpenMM executes its steps from then on.
 */
void sier_forget(const void* integrator, const Program* which) {
    shared_ptr<Program> program = findProgram(integrator);
    if (program == nullptr || program.get() != which)
        return;
    if (program->kernel != nullptr)
        program->kernel->release();
    lock_guard<mutex> guard(access);
    programs().erase(integrator);
}

/** Return whether a Context executes the program of an integrator. */
int sier_is_executed(const void* integrator) {
    shared_ptr<Program> program = findProgram(integrator);
    return program != nullptr && program->kernel != nullptr;
}

/** Set the step in ps by which time advances, and the scalars, always of the same number. */
void sier_set_scalars(const void* integrator, double step, const double* values, int size) {
    shared_ptr<Program> program = findProgram(integrator);
    if (program == nullptr)
        return;
    program->step = step;
    program->scalars.assign(values, values + size);
    program->areScalarsNew = true;
}

/**
 * Execute a block of commands several times. Return a message where that fails, else null; the message is valid until
 * the next call.
 */
const char* sier_run(const void* integrator, int block, int times, int areForcesKnown, double* energy) {
    static thread_local string message;
    shared_ptr<Program> program = findProgram(integrator);
    if (program == nullptr || program->kernel == nullptr)
        return "No Context executes this program";
    try {
        *energy = program->kernel->runBlock(block, times, areForcesKnown != 0);
        return nullptr;
    }
    catch (exception& error) {
        message = error.what();
        return message.c_str();
    }
}

/** Write a table of numbers of a Context. */
void sier_write_numbers(const void* integrator, const char* name, const double* values) {
    shared_ptr<Program> program = findProgram(integrator);
    if (program != nullptr && program->kernel != nullptr)
        program->kernel->writeNumbers(name, values);
}

/** Set all sums of a name to zero, or read them. */
void sier_clear_totals(const void* integrator, const char* name) {
    shared_ptr<Program> program = findProgram(integrator);
    if (program != nullptr && program->kernel != nullptr)
        program->kernel->clearTotals(name);
}

void sier_read_totals(const void* integrator, const char* name, double* values) {
    shared_ptr<Program> program = findProgram(integrator);
    if (program == nullptr || program->kernel == nullptr)
        return;
    vector<long long> totals = program->kernel->readTotals(name);
    copy(totals.begin(), totals.end(), values);
}

/** Read a table of vectors of four, one for each atom, as (N, 3) numbers; leave them where no Context has it. */
void sier_read_vectors(const void* integrator, const char* name, double* values) {
    shared_ptr<Program> program = findProgram(integrator);
    if (program != nullptr && program->kernel != nullptr)
        program->kernel->readVectors(name, values);
}

/** Return a sum, and set it to zero. */
double sier_take_total(const void* integrator, const char* name) {
    shared_ptr<Program> program = findProgram(integrator);
    if (program == nullptr || program->kernel == nullptr)
        return 0.0;
    return program->kernel->takeTotal(name);
}
}
