//! Work limit of quick steps.
//!
//! Finer models have more nodes in the strained region: under a sphere 15 mm deep 500 at 4 mm and 3,000 at 2 mm, which
//! took 10 ms. The time of a step is fixed, the strain limits of deferred elements are not. They are widened while the
//! active set exceeds the work limit, and narrowed when it is well below. Of the strained elements of the last set the
//! next one keeps the most strained, as many as the load allows; required elements come on top. The rule counts nodes and reads no clock, so equal steps give equal bits.

/// Nodes that fit in the time of a quick step.
const NODES_MAX: f64 = 1200.0;
/// Cost of a coarse element in nodes.
const ELEMENT_COST: f64 = 0.25;
/// Part of the work limit below which strain limits are narrowed, and a step refines a further element.
const SPARE: f64 = 0.8;
/// Maximum factor of the strain limits.
const FACTOR_MAX: f64 = 8.0;

/// Factor of the strain limits of deferred elements, and size of the last active set relative to the work limit.
#[derive(Clone, Copy)]
pub(super) struct WorkLimit {
    factor: f64,
    load: f64,
}

impl WorkLimit {
    pub(super) const NONE: Self = Self {
        factor: 1.0,
        load: 0.0,
    };

    /// Updates the factor by the active set of a quick step.
    pub(super) fn update(&mut self, nodes: usize, elements: usize) {
        let load = (nodes as f64 + ELEMENT_COST * elements as f64) / NODES_MAX;
        if load > 1.0 {
            self.factor = (self.factor * load).min(FACTOR_MAX);
        } else if load < SPARE {
            self.factor = (self.factor * (load / SPARE).max(0.5).sqrt()).max(1.0);
        }
        self.load = load;
    }

    /// Factor of the strain limits in the next quick step.
    pub(super) fn factor(self) -> f32 {
        self.factor as f32
    }

    /// Part of the last active set that fits in the work limit; more than 1 if there is room.
    pub(super) fn fitting(self) -> f64 {
        1.0 / self.load
    }

    /// Whether the next quick step may refine more than it must.
    pub(super) fn leaves_room(self) -> bool {
        self.load < SPARE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn active_set_settles_at_the_work_limit() {
        let mut work_limit = WorkLimit::NONE;
        // The active set halves when the factor is four.
        let mut nodes = 3000.0;
        for _ in 0..40 {
            work_limit.update(nodes as usize, 0);
            nodes = 3000.0 / f64::from(work_limit.factor()).sqrt();
        }
        assert!(
            (SPARE * NODES_MAX..=1.2 * NODES_MAX).contains(&nodes),
            "{nodes}"
        );
        for _ in 0..40 {
            work_limit.update(0, 0);
        }
        assert_eq!(work_limit.factor(), 1.0);
    }
}
