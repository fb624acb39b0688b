//! The quasi-static equilibrium of the length law (Lin 2007, section 3.4) under tools.
//!
//! | module | contents |
//! | --- | --- |
//! | `law`, `fibres`, `modulus` | spring laws of a material: length law, volume term, guard, extreme springs, fibres |
//! | `stabilisation`, `corners` | energies against buckling and collapse of deeply pressed tissue |
//! | `brick`, `kernel`, `lanes` | forces of eight cells at a time, in vectors |
//! | `hierarchy`, `coarsen`, `element`, `matrix` | coarse lattices and their Galerkin operators, per element |
//! | `prolongation` | trilinear interpolation between two levels; its transpose restricts |
//! | `effective_stiffness`, `nodal_stiffness`, `secant_stiffness` | answer of elements that a quick step defers |
//! | `coarse_level`, `cycle`, `outer_residual` | active part of a level, V-cycle, forces outside the active part |
//! | `contact_stiffness`, `coarse_stiffening` | contacts, held nodes and hardened tissue on the coarse levels |
//! | `fine_level`, `active_set`, `corrections` | forces on nodes, refinement, coarse corrections |
//! | `jacobi_blocks`, `smoothing`, `contact_smoother` | block Jacobi preconditioner, Chebyshev steps on nodes and at contacts |
//! | `budget`, `work_limit` | limits and report of a step; bound on active nodes |
//! | `reference_state`, `weight` | equilibrium without tools; gravity |
//! | `conjugate` | Krylov acceleration of full solves |
//! | `warm_start` | extrapolation of the last step under tools |
//! | `step_length` | line search |
//! | `mechanism` | mechanisms that an ablation can switch off |
//! | `prescribed` | nodes with a prescribed displacement |
//! | `cut_preparer`, `hierarchy_change`, `construction`, `recoarsen`, `follow_cut` | local update after a cut |
//! | `settling` | first steps after a return to fewer cuts |
//! | `solver` | one step and its stages |
//!
//! A step gathers contacts and applies the warm start. Each iteration then chooses the active set, computes its forces,
//! corrects by a V-cycle with line search, and smooths with block Jacobi Chebyshev steps; proxies move on before the next
//! one. In full solves the energy is minimised over the last two increments before each correction. Coarse operators belong
//! to the rest state, except where tissue has hardened. The order of operations is fixed and no clock is read: equal steps
//! give equal bits, for any number of threads and any vector width.
//!
//! # Performance
//!
//! `palpate-lab bench press-cube` and `press-scene`, one thread of a shared machine. Cube from rest to 1 %: 6.5 ms with
//! 8,000 nodes, 45 ms with 64,000. A real thigh of 70,000 nodes pressed at 100 mm/s: 1.9 ms per tick (99 % below
//! 3.1 ms), force error 0.7 % of the largest force (rms); withdrawal 2.1 ms (3.7 ms), 0.8 %. With 528,000 nodes: 2.9 ms
//! (3.8 ms), 1.5 %; withdrawal 3.0 ms (4.1 ms), 4.1 %.
//!
//! # Limits
//!
//! Coarse operators follow hardening but not rotation. Tissue without `bottoms_out` folds from 30 % of a layer's thickness
//! on. Tissue of springs alone that is pressed flat on bone has several states: a held tool feels 4 % of scatter (8 mm of
//! tissue, 7.8 mm deep). A Poisson's ratio of 0.45 takes twice the iterations of springs alone, 0.49 ten times. A point
//! tool (radius below half a spacing) feels the corners of the mesh, and slips between the samples of a soft surface when
//! it is pressed deeper than its own radius.

// SIMD code must be inlined into the dispatched function.
#![allow(clippy::inline_always)]

mod active_set;
mod brick;
mod budget;
mod chain;
mod coarse_level;
mod coarse_stiffening;
mod coarsen;
mod conjugate;
mod construction;
mod contact_smoother;
mod contact_stiffness;
mod corners;
#[cfg(test)]
mod correction_tests;
mod corrections;
mod cut_preparer;
mod cycle;
#[cfg(test)]
mod deferred_tests;
mod effective_stiffness;
mod element;
mod fibres;
mod fine_level;
mod follow_cut;
mod hierarchy;
mod hierarchy_change;
mod jacobi_blocks;
mod journal;
mod kernel;
mod kinds;
mod lanes;
mod law;
mod matrix;
mod mechanism;
mod modulus;
mod nodal_stiffness;
mod outer_residual;
mod prescribed;
mod prolongation;
mod quad;
mod recoarsen;
mod reference_state;
mod reversal;
mod secant_stiffness;
mod settling;
mod sizes;
mod smoothing;
mod solver;
mod stabilisation;
mod step_length;
mod volume;
mod warm_start;
mod weight;
mod work_limit;

pub(crate) use budget::STEADY;
pub use budget::{Budget, StepReport};
pub use cut_preparer::{CutPreparer, PreparedCut, Retired, TopologyCut};
pub(crate) use lanes::Wide;
pub(crate) use law::Elastic;
pub(crate) use mechanism::Disabled;
pub use mechanism::Mechanism;
pub use modulus::Tension;
pub(crate) use quad::{SLACK, laid_out, overlaid, reserve, trim};
pub use reference_state::Sag;
pub(crate) use solver::Solver;
