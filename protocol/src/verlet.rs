//! Verlet steps.
