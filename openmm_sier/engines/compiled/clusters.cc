// Atoms with constraints to one other atom, each set of which a thread moves. See `motion.cc`.

// Passes of the solvers of constraints, each of which makes errors several times smaller, and the relative error at
// which they stop.
#define MOST_PASSES 60
#ifdef USE_SINGLE_PRECISION
#define CONVERGED 1e-6f
#else
#define CONVERGED 1e-12
#endif

// The centre of a cluster is its atom 0. Positions are relative to an origin near by, so that single precision is enough
// for lengths; y are those without constraint forces since x.
typedef struct {
    int size;
    mixed3 origin;
    int atoms[MOST_IN_CLUSTER];
    mixed lengths[MOST_IN_CLUSTER];
    mixed w[MOST_IN_CLUSTER];
    mixed3 x[MOST_IN_CLUSTER], v[MOST_IN_CLUSTER], y[MOST_IN_CLUSTER];
} Cluster;

DEVICE void readCluster(Cluster* c, GLOBAL const int* RESTRICT atoms, GLOBAL const mixed* RESTRICT lengths, POSITIONS,
                        GLOBAL const mixed4* RESTRICT velm) {
    c->size = atoms[0];
    c->origin = positionOf(THE_POSITIONS, atoms[1]);
    for (int k = 0; k < c->size; k++) {
        const int i = atoms[k + 1];
        c->atoms[k] = i;
        c->lengths[k] = lengths[k];
        c->w[k] = velm[i].w;
        c->x[k] = positionOf(THE_POSITIONS, i) - c->origin;
        c->v[k] = velocityOf(velm, i);
    }
}

DEVICE void placeCluster(const Cluster* c, POSITIONS) {
    for (int k = 0; k < c->size; k++)
        putPosition(THE_POSITIONS, c->atoms[k], c->origin + c->x[k]);
}

DEVICE void writeVelocities(const Cluster* c, GLOBAL mixed4* RESTRICT velm) {
    for (int k = 0; k < c->size; k++)
        putVelocity(velm, c->atoms[k], c->v[k]);
}

DEVICE void kickCluster(Cluster* c, mixed time, GLOBAL const mm_long* RESTRICT force) {
    for (int k = 0; k < c->size; k++)
        c->v[k] += (time*PER_UNIT*c->w[k])*forceOn(force, c->atoms[k]);
}

// Take away what vectors at positions x have along the constraints, with masses as weights.
DEVICE void projectVectors(const Cluster* c, const mixed3* x, mixed3* v) {
    for (int pass = 0; pass < MOST_PASSES; pass++) {
        bool isDone = true;
        for (int k = 1; k < c->size; k++) {
            const mixed3 r = x[k] - x[0];
            const mixed square = dot(r, r);
            const mixed rate = dot(v[k] - v[0], r)/square;
            if (fabs(rate)*sqrt(square) > CONVERGED*(1 + fabs(v[k].x) + fabs(v[k].y) + fabs(v[k].z)))
                isDone = false;
            const mixed g = rate/(c->w[0] + c->w[k]);
            v[0] += (g*c->w[0])*r;
            v[k] -= (g*c->w[k])*r;
        }
        if (isDone)
            break;
    }
}

// Move positions y onto the constraints along the bonds at x (Ryckaert, Ciccotti and Berendsen, J. Comput. Phys. 23,
// 327 (1977)), to become x; the displacement over a time changes velocities.
DEVICE void constrainCluster(Cluster* c, mixed time) {
    mixed3 z[MOST_IN_CLUSTER];
    for (int k = 0; k < c->size; k++)
        z[k] = c->y[k];
    for (int pass = 0; pass < MOST_PASSES; pass++) {
        bool isDone = true;
        for (int k = 1; k < c->size; k++) {
            const mixed3 r = c->x[k] - c->x[0];
            const mixed3 s = z[k] - z[0];
            const mixed square = c->lengths[k]*c->lengths[k];
            const mixed excess = dot(s, s) - square;
            if (fabs(excess) > 2*CONVERGED*square)
                isDone = false;
            const mixed g = excess/(2*(c->w[0] + c->w[k])*dot(r, s));
            z[0] += (g*c->w[0])*r;
            z[k] -= (g*c->w[k])*r;
        }
        if (isDone)
            break;
        // No motion goes on from constraints that are broken.
        if (pass == MOST_PASSES - 1)
            z[0] = make_mixed3(sqrt((mixed) -1), 0, 0);
    }
    for (int k = 0; k < c->size; k++) {
        c->v[k] += (1/time)*(z[k] - c->y[k]);
        c->x[k] = z[k];
    }
}

// Make one step of RATTLE (Andersen, J. Comput. Phys. 52, 24 (1983)).
DEVICE void driftCluster(Cluster* c, mixed time) {
    for (int k = 0; k < c->size; k++)
        c->y[k] = c->x[k] + time*c->v[k];
    constrainCluster(c, time);
}

// Begin a step of RATTLE with a bath in its middle. What velocities have along the constraints would move atoms here,
// and the bath would change it.
DEVICE void driftClusterToBath(Cluster* c, mixed time) {
    projectVectors(c, c->x, c->v);
    for (int k = 0; k < c->size; k++)
        c->y[k] = c->x[k] + time*c->v[k];
}

// End a step of RATTLE with a bath in its middle: the constraints act over both halves.
DEVICE void driftClusterFromBath(Cluster* c, mixed time) {
    for (int k = 0; k < c->size; k++)
        c->y[k] += time*c->v[k];
    constrainCluster(c, 2*time);
}

// Displace a cluster by `shift` times its accelerations, under its constraints.
DEVICE void displaceCluster(Cluster* c, mixed shift, GLOBAL const mm_long* RESTRICT force, GLOBAL mixed4* RESTRICT kept) {
    Cluster moved = *c;
    for (int k = 0; k < c->size; k++) {
        keepVector(c->atoms[k], c->origin + c->x[k], kept);
        moved.y[k] = c->x[k] + (shift*PER_UNIT*c->w[k])*forceOn(force, c->atoms[k]);
    }
    constrainCluster(&moved, 1);
    for (int k = 0; k < c->size; k++)
        c->x[k] = moved.x[k];
}

// Bring a cluster back from displaced positions, and change velocities by the forces there along the constraints.
DEVICE void kickClusterFrom(Cluster* c, mixed time, GLOBAL const mixed4* RESTRICT kept, GLOBAL const mm_long* RESTRICT force) {
    mixed3 a[MOST_IN_CLUSTER];
    for (int k = 0; k < c->size; k++)
        a[k] = (PER_UNIT*c->w[k])*forceOn(force, c->atoms[k]);
    projectVectors(c, c->x, a);
    c->origin = trim(kept[c->atoms[0]]);
    for (int k = 0; k < c->size; k++) {
        c->v[k] += time*a[k];
        c->x[k] = trim(kept[c->atoms[k]]) - c->origin;
    }
}

DEVICE void bathCluster(Cluster* c, GLOBAL const mixed* bath, GLOBAL const float4* noise, GLOBAL mixed4* RESTRICT bathed) {
    for (int k = 0; k < c->size; k++) {
        c->v[k] = bathVelocity(c->v[k], c->w[k], bath, noise[k]);
        keepVector(c->atoms[k], c->v[k], bathed);
    }
}

// Multiply velocities by a factor, and add a velocity.
DEVICE void changeCluster(Cluster* c, mixed factor, mixed3 shift) {
    for (int k = 0; k < c->size; k++)
        c->v[k] = factor*c->v[k] + shift;
}

DEVICE mixed3 momentumOfCluster(const Cluster* c) {
    mixed3 momentum = make_mixed3(0, 0, 0);
    for (int k = 0; k < c->size; k++)
        momentum += (1/c->w[k])*c->v[k];
    return momentum;
}

DEVICE mixed kineticEnergyOfCluster(const Cluster* c) {
    mixed energy = 0;
    for (int k = 0; k < c->size; k++)
        energy += NUMBER(0.5)/c->w[k]*dot(c->v[k], c->v[k]);
    return energy;
}
