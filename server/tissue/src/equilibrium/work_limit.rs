//! Work limit of quick steps.
//!
//! Finer models have more nodes in the strained region: under a sphere 15 mm deep 500 at 4 mm and 3,000 at 2 mm, which
//! took 10 ms. The time of a step is fixed, the tolerances of deferred elements are not. They are widened while the
//! active set exceeds the limit, and narrowed when it is well below. The rule counts nodes and reads no clock, so equal
//! steps give equal bits.

/// Nodes that fit in the time of a quick step.
const NODES_MAX: f64 = 1200.0;
/// Cost of a coarse element in nodes.
const ELEMENT_COST: f64 = 0.25;
/// Part of the limit below which tolerances are narrowed, and a step refines a further element.
pub(super) const SPARE: f64 = 0.8;
/// Maximum factor of the tolerances; beyond it only the contacts remain active.
const FACTOR_MAX: f64 = 8.0;

/// Size of the active set, relative to the limit.
pub(super) fn load(nodes: usize, elements: usize) -> f64 {
    (nodes as f64 + ELEMENT_COST * elements as f64) / NODES_MAX
}

/// Factor of the tolerances of deferred elements.
#[derive(Clone, Copy)]
pub(super) struct WorkLimit(f64);

impl WorkLimit {
    pub(super) const NONE: Self = Self(1.0);

    /// Updates the factor by the load of the last step; returns it for the next one.
    pub(super) fn update(&mut self, load: f64) -> f32 {
        if load > 1.0 {
            self.0 = (self.0 * load).min(FACTOR_MAX);
        } else if load < SPARE {
            self.0 = (self.0 * (load / SPARE).max(0.5).sqrt()).max(1.0);
        }
        self.0 as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn active_set_settles_at_the_work_limit() {
        let mut work_limit = WorkLimit::NONE;
        // The active set halves when the tolerance factor is four.
        let mut nodes = 3000.0;
        for _ in 0..40 {
            nodes = 3000.0 / f64::from(work_limit.update(load(nodes as usize, 0))).sqrt();
        }
        assert!(
            (SPARE * NODES_MAX..=1.2 * NODES_MAX).contains(&nodes),
            "{nodes}"
        );
        for _ in 0..40 {
            work_limit.update(0.0);
        }
        assert_eq!(work_limit.update(0.0), 1.0);
    }
}
