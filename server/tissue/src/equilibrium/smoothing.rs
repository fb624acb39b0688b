//! Range and number of the Chebyshev steps on the nodes.
//!
//! The blocks of the smoother bound the volume term, which motions without change of volume do not feel. On a lattice of
//! cubes springs add 6 μ Δd to the block of a node, of which [`SPRINGS`] times as much enters, and volume terms add
//! 4 κ Δd. So the eigenvalues of shear waves are those of springs alone over 1 + 4κ/(6 [`SPRINGS`] μ), and the range
//! begins lower by that factor. A wider range needs one more step.

use super::cycle::{Chebyshev, LOW};
use super::kernel::SPRINGS;
use super::law::Elastic;
use crate::Model;

/// Steps after each coarse correction: of springs alone, and with volume terms.
const STEPS: [usize; 2] = [3, 4];

/// Smoothing of the nodes.
#[derive(Clone, Copy)]
pub(super) struct Smoothing {
    pub(super) steps: usize,
    /// Lowest eigenvalue that is damped, relative to the bound of all eigenvalues.
    low: f32,
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
    pub(super) fn factors(&self) -> Chebyshev {
        Chebyshev::new(self.low)
    }
}
