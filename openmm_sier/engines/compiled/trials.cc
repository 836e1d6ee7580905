// Kernels of trials of hybrid Monte Carlo, which leave everything but numbers on the device.

// Draw velocities: `values` are the factor of the old ones, the width of noise at unit mass, and a velocity that is
// added to the old ones first.
KERNEL void sierDraw(PARAMETERS) {
    for (int i = GLOBAL_ID; i < NUM_PARTICLES; i += GLOBAL_SIZE) {
        const mixed w = velm[i].w;
        const float4 g = random[randomIndex + i];
        const mixed3 old = velocityOf(velm, i) + make_mixed3(values[2], values[3], values[4]);
        if (w > 0)
            putVelocity(velm, i, values[0]*old + (values[1]*sqrt(w))*make_mixed3(g.x, g.y, g.z));
    }
}

// Multiply velocities by a factor, and add a velocity.
KERNEL void sierChange(PARAMETERS) {
    for (int i = GLOBAL_ID; i < NUM_PARTICLES; i += GLOBAL_SIZE)
        if (velm[i].w > 0)
            putVelocity(velm, i, values[0]*velocityOf(velm, i) + make_mixed3(values[2], values[3], values[4]));
}

KERNEL void sierKeep(PARAMETERS) {
    for (int i = GLOBAL_ID; i < NUM_PARTICLES; i += GLOBAL_SIZE) {
        const mixed3 x = positionOf(THE_POSITIONS, i);
        startX[i] = make_mixed4(x.x, x.y, x.z, 0);
        startV[i] = velm[i];
    }
}

// Restore the start with reversed velocities.
KERNEL void sierGoBack(PARAMETERS) {
    for (int i = GLOBAL_ID; i < NUM_PARTICLES; i += GLOBAL_SIZE) {
        putPosition(THE_POSITIONS, i, trim(startX[i]));
        putVelocity(velm, i, (mixed) -1*trim(startV[i]));
    }
}

// Sum the kinetic energy and the momentum of all atoms, by one block of threads.
KERNEL void sierSumMotion(PARAMETERS) {
    LOCAL mixed parts[4*SUM_TEAM];
    mixed energy = 0;
    mixed3 momentum = make_mixed3(0, 0, 0);
    for (int i = LOCAL_ID; i < NUM_PARTICLES; i += LOCAL_SIZE) {
        const mixed w = velm[i].w;
        if (w > 0) {
            const mixed3 v = velocityOf(velm, i);
            energy += NUMBER(0.5)/w*dot(v, v);
            momentum += (1/w)*v;
        }
    }
    parts[4*LOCAL_ID] = energy;
    parts[4*LOCAL_ID + 1] = momentum.x;
    parts[4*LOCAL_ID + 2] = momentum.y;
    parts[4*LOCAL_ID + 3] = momentum.z;
    SYNC_THREADS;
    for (int span = LOCAL_SIZE/2; span > 0; span /= 2) {
        if (LOCAL_ID < span)
            for (int k = 0; k < 4; k++)
                parts[4*LOCAL_ID + k] += parts[4*(LOCAL_ID + span) + k];
        SYNC_THREADS;
    }
    if (LOCAL_ID < 4)
        sums[LOCAL_ID] = parts[LOCAL_ID];
}
