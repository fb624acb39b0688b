//! Work limit of quick steps.
//!
//! Finer models have more nodes in the strained region: under a sphere 15 mm deep 500 at 4 mm and 3,000 at 2 mm, which
//! took 10 ms. The time of a step is fixed, the tolerances of deferred elements are not. They are widened while the
//! active set exceeds the limit, and narrowed when it is well below. The rule counts nodes and reads no clock, so equal
//! steps give equal bits.

/// Nodes that fit in the time of a quick step.
const ROOM: f64 = 900.0;
/// Cost of a coarse element in nodes.
const ELEMENT: f64 = 0.25;
/// Fraction of the limit below which tolerances are narrowed.
const ROOMY: f64 = 0.8;
/// Maximum factor of the tolerances; beyond it only the contacts remain active.
const WIDEST: f64 = 8.0;

/// Factor of the tolerances of deferred elements.
#[derive(Clone, Copy)]
pub(super) struct WorkLimit(f64);

impl WorkLimit {
    pub(super) const NONE: Self = Self(1.0);

    /// Updates the factor by the active set of the last step; returns it for the next one.
    pub(super) fn after(&mut self, nodes: usize, elements: usize) -> f32 {
        let load = (nodes as f64 + ELEMENT * elements as f64) / ROOM;
        if load > 1.0 {
            self.0 = (self.0 * load).min(WIDEST);
        } else if load < ROOMY {
            self.0 = (self.0 * (load / ROOMY).max(0.5).sqrt()).max(1.0);
        }
        self.0 as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn active_set_settles_at_the_work_limit() {
        let mut relief = WorkLimit::NONE;
        // The active set halves when the tolerance factor is four.
        let mut nodes = 3000.0;
        for _ in 0..40 {
            nodes = 3000.0 / f64::from(relief.after(nodes as usize, 0)).sqrt();
        }
        assert!((ROOMY * ROOM..=1.2 * ROOM).contains(&nodes), "{nodes}");
        for _ in 0..40 {
            relief.after(0, 0);
        }
        assert_eq!(relief.after(0, 0), 1.0);
    }
}
