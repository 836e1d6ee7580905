// What kernels of the kernels engine have in common. It is written in the language that OpenMM compiles for CUDA, HIP
// and OpenCL alike. `kernel_text.py` adds constants before it, the functions of `rotation.py` where formulas are needed, and the kernels.
//
// Tables, see `body_tables.py`: a body is its first atom in `bodyAtoms`, its number of atoms, its first site in `sites`, and
// its kind. A kind is six vectors of four in `kinds`: inverse moments and inverse mass; rates of the free rotation and
// the root of the mass; roots of moments; and the axes of its reference frame in its principal frame. `references` are
// the atoms that span this frame.

#ifdef USE_SINGLE_PRECISION
#define NUMBER(x) x##f
#else
#define NUMBER(x) x
#endif

#ifdef USE_MIXED_PRECISION
#define POSITIONS GLOBAL real4* RESTRICT posq, GLOBAL real4* RESTRICT posqCorrection
#define THE_POSITIONS posq, posqCorrection
#else
#define POSITIONS GLOBAL real4* RESTRICT posq
#define THE_POSITIONS posq
#endif

// Threads that share one body. Each has every LANES-th atom, and sums are those of all of them.
#if LANES > 1
#define LANE LOCAL_ID
#define TEAM , LOCAL_ARG mixed* RESTRICT buffer
#define THE_TEAM , buffer
#define SUM(v) sumOfTeam(v, buffer)
#define WAIT_FOR_TEAM SYNC_THREADS
#else
#define LANE 0
#define TEAM
#define THE_TEAM
#define SUM(v) (v)
#define WAIT_FOR_TEAM
#endif

// kJ/mol/nm in one unit of OpenMM's forces.
#define PER_UNIT NUMBER(2.3283064365386963e-10)

#define BODY_TABLES GLOBAL const int* RESTRICT bodyAtoms, GLOBAL const mixed4* RESTRICT sites, GLOBAL const mixed4* RESTRICT kinds
#define THE_BODY_TABLES bodyAtoms, sites, kinds

// The largest number of parts of one free rotation. A body that turns further has no motion that doubles could follow.
#define MOST_PARTS 8192

// --- formulas ---

typedef struct {
    mixed3 q, p, L;  // centre, momentum, angular momentum about the centre
    mixed3 e[3];     // principal axes
} Body;

DEVICE mixed3 positionOf(POSITIONS, int i) {
    const real4 x = posq[i];
#ifdef USE_MIXED_PRECISION
    const real4 y = posqCorrection[i];
    return make_mixed3(x.x + (mixed) y.x, x.y + (mixed) y.y, x.z + (mixed) y.z);
#else
    return make_mixed3(x.x, x.y, x.z);
#endif
}

// Where a position is not a number, OpenMM's kernels would write beyond their arrays. Its velocity shows that it is lost.
DEVICE void putPosition(POSITIONS, int i, mixed3 x) {
    if (!(dot(x, x) < NUMBER(1e30)))
        return;
    posq[i] = make_real4((real) x.x, (real) x.y, (real) x.z, posq[i].w);
#ifdef USE_MIXED_PRECISION
    posqCorrection[i] = make_real4(x.x - (real) x.x, x.y - (real) x.y, x.z - (real) x.z, 0);
#endif
}

// Keep a vector of an atom in a table.
DEVICE void keepVector(int i, mixed3 v, GLOBAL mixed4* RESTRICT table) {
    table[i] = make_mixed4(v.x, v.y, v.z, 0);
}

DEVICE mixed3 velocityOf(GLOBAL const mixed4* RESTRICT velm, int i) {
    const mixed4 v = velm[i];
    return make_mixed3(v.x, v.y, v.z);
}

DEVICE void putVelocity(GLOBAL mixed4* RESTRICT velm, int i, mixed3 v) {
    velm[i] = make_mixed4(v.x, v.y, v.z, velm[i].w);
}

#if LANES > 1
DEVICE mixed3 sumOfTeam(mixed3 v, LOCAL_ARG mixed* RESTRICT buffer) {
    buffer[LANE] = v.x;
    buffer[LANES + LANE] = v.y;
    buffer[2*LANES + LANE] = v.z;
    SYNC_THREADS;
    for (int span = LANES/2; span > 0; span /= 2) {
        if (LANE < span)
            for (int x = 0; x < 3; x++)
                buffer[x*LANES + LANE] += buffer[x*LANES + LANE + span];
        SYNC_THREADS;
    }
    const mixed3 sum = make_mixed3(buffer[0], buffer[LANES], buffer[2*LANES]);
    SYNC_THREADS;
    return sum;
}
#endif

// Return the force on an atom, in units of 2^-32 kJ/mol/nm.
DEVICE mixed3 forceOn(GLOBAL const mm_long* RESTRICT force, int i) {
    return make_mixed3((mixed) force[i], (mixed) force[i + PADDED_NUM_ATOMS], (mixed) force[i + 2*PADDED_NUM_ATOMS]);
}

DEVICE mixed3 combine(mixed3 w, const mixed3* e) {
    return w.x*e[0] + w.y*e[1] + w.z*e[2];
}

// Return what a lab vector is in the principal frame.
DEVICE mixed3 inBody(mixed3 v, const mixed3* e) {
    return make_mixed3(dot(v, e[0]), dot(v, e[1]), dot(v, e[2]));
}

DEVICE mixed3 trim(mixed4 v) {
    return make_mixed3(v.x, v.y, v.z);
}

DEVICE mixed3 times(mixed3 a, mixed3 b) {
    return make_mixed3(a.x*b.x, a.y*b.y, a.z*b.z);
}

DEVICE mixed3 unitVector(mixed3 v) {
    return v*(1/sqrt(dot(v, v)));
}

// Set the principal axes of a body by three of its atoms, or by two of a linear one, whose third number is -1.
DEVICE void setAxes(Body* body, int4 record, int4 reference, POSITIONS, BODY_TABLES) {
    GLOBAL const int* atoms = bodyAtoms + record.x;
    GLOBAL const mixed4* frame = kinds + 6*record.w + 3;
    const mixed3 origin = positionOf(THE_POSITIONS, atoms[reference.x]);
    mixed3 r[3];
    r[0] = unitVector(positionOf(THE_POSITIONS, atoms[reference.y]) - origin);
    mixed3 other;
    if (reference.z >= 0)
        other = positionOf(THE_POSITIONS, atoms[reference.z]) - origin;
    else
        other = make_mixed3(fabs(r[0].x) < NUMBER(0.6), fabs(r[0].x) >= NUMBER(0.6), 0);
    r[2] = unitVector(cross(r[0], other));
    r[1] = cross(r[2], r[0]);
    const mixed3 a = trim(frame[0]), b = trim(frame[1]), c = trim(frame[2]);
    body->e[0] = combine(make_mixed3(a.x, b.x, c.x), r);
    body->e[1] = combine(make_mixed3(a.y, b.y, c.y), r);
    body->e[2] = combine(make_mixed3(a.z, b.z, c.z), r);
}

// Return a body from its atoms.
DEVICE Body readBody(int4 record, int4 reference, POSITIONS, GLOBAL const mixed4* RESTRICT velm, BODY_TABLES TEAM) {
    Body body;
    setAxes(&body, record, reference, THE_POSITIONS, THE_BODY_TABLES);
    mixed3 q = make_mixed3(0, 0, 0), p = make_mixed3(0, 0, 0), L = make_mixed3(0, 0, 0);
    for (int k = LANE; k < record.y; k += LANES) {
        const int i = bodyAtoms[record.x + k];
        const mixed4 site = sites[record.z + k];
        const mixed3 momentum = site.w*velocityOf(velm, i);
        q += site.w*positionOf(THE_POSITIONS, i);
        p += momentum;
        L += cross(combine(trim(site), body.e), momentum);
    }
    body.q = SUM(q)*kinds[6*record.w].w;
    body.p = SUM(p);
    body.L = SUM(L);
    return body;
}

// Write the positions of the atoms of a body.
DEVICE void placeBody(Body* body, int4 record, POSITIONS, BODY_TABLES) {
    for (int k = LANE; k < record.y; k += LANES) {
        const mixed3 arm = combine(trim(sites[record.z + k]), body->e);
        putPosition(THE_POSITIONS, bodyAtoms[record.x + k], body->q + arm);
    }
}

// Write the velocities of the atoms of a body.
DEVICE void moveBody(Body* body, int4 record, GLOBAL mixed4* RESTRICT velm, BODY_TABLES) {
    const mixed4 inverse = kinds[6*record.w];
    const mixed3 velocity = inverse.w*body->p;
    const mixed3 spin = combine(times(trim(inverse), inBody(body->L, body->e)), body->e);
    for (int k = LANE; k < record.y; k += LANES) {
        const mixed3 arm = combine(trim(sites[record.z + k]), body->e);
        putVelocity(velm, bodyAtoms[record.x + k], velocity + cross(spin, arm));
    }
}

// Change momenta by the forces on the atoms of a body.
DEVICE void kickBody(Body* body, int4 record, mixed time, GLOBAL const mm_long* RESTRICT force, BODY_TABLES TEAM) {
    const mixed scale = time*PER_UNIT;
    mixed3 total = make_mixed3(0, 0, 0), torque = make_mixed3(0, 0, 0);
    for (int k = LANE; k < record.y; k += LANES) {
        const mixed3 f = forceOn(force, bodyAtoms[record.x + k]);
        total += f;
        torque += cross(combine(trim(sites[record.z + k]), body->e), f);
    }
    body->p += scale*SUM(total);
    body->L += scale*SUM(torque);
}

// Turn the axes of a body by a quaternion of the principal frame.
DEVICE void turnAxes(Body* body, const mixed* turn) {
    mixed rows[9];
    rotationMatrix(turn, rows);
    mixed3 e[3];
    for (int j = 0; j < 3; j++)
        e[j] = combine(make_mixed3(rows[3*j], rows[3*j + 1], rows[3*j + 2]), body->e);
    for (int j = 0; j < 3; j++)
        body->e[j] = e[j];
}

// Move the centre of a body, and turn it freely.
DEVICE void driftBody(Body* body, int4 record, mixed time, BODY_TABLES) {
    body->q += (time*kinds[6*record.w].w)*body->p;
    const mixed4 kindRates = kinds[6*record.w + 1];
    const mixed norm = sqrt(dot(body->L, body->L));
    if (norm == 0 || kindRates.x == 0)
        return;
    const mixed3 direction = (1/norm)*inBody(body->L, body->e);
    mixed rates[3] = {kindRates.x, kindRates.y, kindRates.z};
    mixed u[3] = {direction.x, direction.y, direction.z};
    mixed k = norm*time;
    // Parts compose exactly.
    int parts = 1;
    const mixed wanted = ceil(phaseOf(rates, u, k)*(1/LONGEST_PHASE));
    if (wanted > MOST_PARTS)
        k = sqrt((mixed) -1);
    else if (wanted > 1)
        parts = (int) wanted;
    k /= parts;
    mixed turn[4] = {1, 0, 0, 0}, part[4], next[3], product[4];
    for (int i = 0; i < parts; i++) {
        turnFreely(rates, u, k, part, next);
        multiplyQuaternions(part, turn, product);
        const mixed inverse = 1/sqrt(next[0]*next[0] + next[1]*next[1] + next[2]*next[2]);
        for (int j = 0; j < 3; j++)
            u[j] = inverse*next[j];
        for (int j = 0; j < 4; j++)
            turn[j] = product[j];
    }
    turnAxes(body, turn);
}

// Let an Ornstein-Uhlenbeck process act on momenta, and on angular momenta along the principal axes.
DEVICE void bathBody(Body* body, int4 record, GLOBAL const mixed* bath, GLOBAL const float4* noise, BODY_TABLES) {
    const float4 g = noise[0], h = noise[1];
    const mixed3 roots = trim(kinds[6*record.w + 2]);
    body->p = bath[0]*body->p + (bath[1]*kinds[6*record.w + 1].w)*make_mixed3(g.x, g.y, g.z);
    body->L = bath[2]*body->L + bath[3]*combine(times(roots, make_mixed3(h.x, h.y, h.z)), body->e);
}

DEVICE mixed kineticEnergyOfBody(Body* body, int4 record, BODY_TABLES) {
    const mixed4 inverse = kinds[6*record.w];
    const mixed3 along = inBody(body->L, body->e);
    return NUMBER(0.5)*(inverse.w*dot(body->p, body->p) + dot(trim(inverse), times(along, along)));
}

DEVICE mixed3 bathVelocity(mixed3 v, mixed inverseMass, GLOBAL const mixed* bath, float4 noise) {
    return bath[0]*v + (bath[1]*sqrt(inverseMass))*make_mixed3(noise.x, noise.y, noise.z);
}

// A number of `totals`.
DEVICE mm_long fixedPoint(mixed energy) {
    return (mm_long) (energy*NUMBER(4294967296.0));
}

// --- gradient kicks ---

DEVICE void keepPositions(int4 record, POSITIONS, GLOBAL mixed4* RESTRICT kept, GLOBAL const int* RESTRICT bodyAtoms) {
    for (int k = LANE; k < record.y; k += LANES) {
        const int i = bodyAtoms[record.x + k];
        keepVector(i, positionOf(THE_POSITIONS, i), kept);
    }
}

// Bring back the positions that were kept, and keep those that there were.
DEVICE void swapPositions(int4 record, POSITIONS, GLOBAL mixed4* RESTRICT kept, GLOBAL const int* RESTRICT bodyAtoms) {
    for (int k = LANE; k < record.y; k += LANES) {
        const int i = bodyAtoms[record.x + k];
        const mixed3 x = positionOf(THE_POSITIONS, i);
        putPosition(THE_POSITIONS, i, trim(kept[i]));
        keepVector(i, x, kept);
    }
    WAIT_FOR_TEAM;
}

// Displace a body by `shift` times its accelerations, as `formulas.displacing_rotation` does.
DEVICE void displaceBody(Body* body, int4 record, mixed shift, GLOBAL const mm_long* RESTRICT force, BODY_TABLES TEAM) {
    const mixed3 p = body->p, L = body->L;
    body->p = make_mixed3(0, 0, 0);
    body->L = make_mixed3(0, 0, 0);
    kickBody(body, record, shift, force, THE_BODY_TABLES THE_TEAM);
    const mixed4 inverse = kinds[6*record.w];
    body->q += inverse.w*body->p;
    const mixed3 angle = NUMBER(-0.5)*times(trim(inverse), inBody(body->L, body->e));
    const mixed turn[4] = {1, angle.x, angle.y, angle.z};
    turnAxes(body, turn);
    body->p = p;
    body->L = L;
}

// Change momenta by the forces on the atoms of a body at other positions.
DEVICE void kickBodyFrom(Body* body, int4 record, mixed time, GLOBAL const mixed4* RESTRICT at,
                         GLOBAL const mm_long* RESTRICT force, GLOBAL const int* RESTRICT bodyAtoms TEAM) {
    const mixed scale = time*PER_UNIT;
    mixed3 total = make_mixed3(0, 0, 0), torque = make_mixed3(0, 0, 0);
    for (int k = LANE; k < record.y; k += LANES) {
        const int i = bodyAtoms[record.x + k];
        const mixed3 f = forceOn(force, i);
        total += f;
        torque += cross(trim(at[i]) - body->q, f);
    }
    body->p += scale*SUM(total);
    body->L += scale*SUM(torque);
}
