// Trials of hybrid Monte Carlo, which leave everything but numbers on the device. See `motion.cc`.
//
// `values` are those of a bath that draws velocities, four numbers of which the first is a factor of velocities, too; a
// velocity that is added to all, three; and the kinetic energy of the start, or 0 to leave it as it is.

// Sums have SUM_SLOTS slots, so that few threads wait for each other. Each has SUM_SIZE numbers: the kinetic energy and the
// momentum along three axes in units of 1/SUM_UNITS, and the number of movers whose energy is not below MOST_ENERGY.

#define START GLOBAL mixed4* RESTRICT startX, GLOBAL mixed4* RESTRICT startV, GLOBAL mm_long* RESTRICT startF
#define THE_START startX, startV, startF

DEVICE void addToSums(GLOBAL mm_ulong* RESTRICT sums, mixed energy, mixed3 momentum) {
    GLOBAL mm_ulong* slot = sums + SUM_SIZE*((GROUP_ID + LOCAL_ID) % SUM_SLOTS);
    // A comparison with NaN is false.
    if (energy < MOST_ENERGY) {
        ATOMIC_ADD(&slot[0], (mm_ulong) (mm_long) (energy*SUM_UNITS));
        ATOMIC_ADD(&slot[1], (mm_ulong) (mm_long) (momentum.x*SUM_UNITS));
        ATOMIC_ADD(&slot[2], (mm_ulong) (mm_long) (momentum.y*SUM_UNITS));
        ATOMIC_ADD(&slot[3], (mm_ulong) (mm_long) (momentum.z*SUM_UNITS));
    }
    else
        ATOMIC_ADD(&slot[4], (mm_ulong) 1);
}

// Return the factor of drawn velocities, by their kinetic energy; NaN where one was left out of it.
DEVICE mixed factorOfStart(GLOBAL const mixed* RESTRICT values, GLOBAL const mm_ulong* RESTRICT sums) {
    if (values[7] == 0)
        return 1;
    mm_ulong drawn = 0, excluded = 0;
    for (int slot = 0; slot < SUM_SLOTS; slot++) {
        drawn += sums[SUM_SIZE*slot];
        excluded += sums[SUM_SIZE*slot + 4];
    }
    return excluded > 0 ? sqrt((mixed) -1) : sqrt(values[7]*SUM_UNITS/(mixed) (mm_long) drawn);
}

DEVICE mixed3 shiftOf(GLOBAL const mixed* RESTRICT values) {
    return make_mixed3(values[4], values[5], values[6]);
}

DEVICE void shiftBody(Body* body, int4 record, GLOBAL const mixed* RESTRICT values, BODY_TABLES) {
    body->p += (1/kinds[6*record.w].w)*shiftOf(values);
}

DEVICE void scaleBody(Body* body, mixed factor) {
    body->p = factor*body->p;
    body->L = factor*body->L;
}

// Keep an atom of the start, whose velocity was not multiplied by its factor yet.
DEVICE void keepStart(int i, POSITIONS, GLOBAL const mixed4* RESTRICT velm, GLOBAL const mm_long* RESTRICT force,
                      mixed factor, START) {
    keepVector(i, positionOf(THE_POSITIONS, i), startX);
    keepVector(i, factor*velocityOf(velm, i), startV);
    for (int x = 0; x < 3; x++)
        startF[i + x*NUM_PARTICLES] = force[i + x*PADDED_NUM_ATOMS];
}

// Restore an atom of the start, with reversed velocity.
DEVICE void goBack(int i, POSITIONS, GLOBAL mixed4* RESTRICT velm, GLOBAL mm_long* RESTRICT force, START) {
    putPosition(THE_POSITIONS, i, trim(startX[i]));
    putVelocity(velm, i, (mixed) -1*trim(startV[i]));
    for (int x = 0; x < 3; x++)
        force[i + x*PADDED_NUM_ATOMS] = startF[i + x*NUM_PARTICLES];
}
