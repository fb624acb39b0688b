//! Range of the Chebyshev steps on all levels but the coarsest, and their number on the nodes.
//!
//! The blocks of the smoother bound the volume term, which motions without change of volume do not feel. On a lattice of
//! cubes springs add 6 μ Δd to the block of a node, of which [`SPRINGS`] times as much enters, and volume terms add
//! 4 κ Δd. So the eigenvalues of shear waves are those of springs alone over 1 + 4κ/(6 [`SPRINGS`] μ), and the range
//! begins lower by that factor. A wider range needs one more step. Blocks of coarse points are bounded otherwise
//! (`element.rs`); that the same range serves them was measured.

use super::cycle::Chebyshev;
use super::kernel::SPRINGS;
use super::law::Elastic;
use crate::Model;

/// Lowest eigenvalue that is damped without volume terms, relative to the bound of all eigenvalues.
const LOW: f32 = 0.15;
/// Steps after each coarse correction: of springs alone, and with volume terms.
const STEPS: [usize; 2] = [3, 4];

/// Factors of the bound after a smoothing whose inner steps amplified the residual, and after any other.
const ADAPTS: [f32; 2] = [1.5, 0.8];
/// Keeps the bound finite where no bound helps; solves converge equally with 100.
const BOUND_MAX: f32 = 8.0;

/// Bound of the eigenvalues of the tangent relative to the smoother's blocks, in full solves.
///
/// The blocks bound the tangent before a smoothing. Contacts that close and corners that collapse meanwhile harden beyond
/// them. Chebyshev polynomials grow fast above their range, which causes limit cycles between smoothing and coarse
/// correction. The bound follows the residual, as a step length does: a polynomial with a higher bound makes shorter
/// steps.
#[derive(Clone, Copy)]
pub(super) struct EigenvalueBound(f32);

impl EigenvalueBound {
    /// The blocks themselves.
    pub(super) const BLOCKS: Self = Self(1.0);

    /// Follows a smoothing, from the sums of squares of the residual after its first step and before its last one.
    pub(super) fn follow(&mut self, [first, last]: [f64; 2]) {
        let factor = ADAPTS[usize::from(last <= first)];
        self.0 = (factor * self.0).clamp(1.0, BOUND_MAX);
    }
}

/// Smoothing of the nodes.
#[derive(Clone, Copy)]
pub(super) struct Smoothing {
    pub(super) steps: usize,
    /// Lowest eigenvalue that is damped, relative to the bound of all eigenvalues.
    pub(super) low: f32,
}

impl Smoothing {
    /// The smoothing of a model: that of its least compressible region that moves.
    pub(super) fn of(model: &Model) -> Self {
        let moving = model.regions.iter().filter(|r| !r.pinned).map(Elastic::of);
        let volume = moving.map(|e| e.bulk_pa / e.shear_pa()).fold(0.0, f64::max);
        Self {
            steps: STEPS[usize::from(volume > 0.0)],
            low: LOW / (1.0 + 4.0 / (6.0 * SPRINGS) * volume as f32),
        }
    }

    /// The coefficients of its steps.
    pub(super) fn factors(&self, bound: EigenvalueBound) -> Chebyshev {
        Chebyshev::new(self.low, bound.0)
    }
}
