//! Recorded poses and forces of a run, for plots and comparisons.

use crate::recording::HapticPoint;

/// Every n-th tick of a run, in preallocated memory.
#[derive(Debug, Clone, Default)]
pub struct Trace {
    points: Vec<HapticPoint>,
    capacity: usize,
    every: u32,
    skipped: u32,
    lost: u64,
}

impl Trace {
    /// Capacity for `capacity` points, one per `every` ticks; `every` = 0 records nothing.
    pub(super) fn new(every: u32, capacity: usize) -> Self {
        let capacity = if every == 0 { 0 } else { capacity };
        Self {
            points: Vec::with_capacity(capacity),
            capacity,
            every,
            skipped: 0,
            lost: 0,
        }
    }

    /// Records every n-th `point` while there is room. Never allocates.
    pub(super) fn record(&mut self, point: HapticPoint) {
        if self.every == 0 {
            return;
        }
        if self.skipped > 0 {
            self.skipped -= 1;
            return;
        }
        self.skipped = self.every - 1;
        if self.points.len() < self.capacity {
            self.points.push(point);
        } else {
            self.lost += 1;
        }
    }

    /// The points in chronological order.
    pub fn points(&self) -> &[HapticPoint] {
        &self.points
    }

    /// Number of points lost at the end of the run for lack of room.
    pub fn lost(&self) -> u64 {
        self.lost
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use palpate_device::{Buttons, Pose};

    use super::{HapticPoint, Trace};

    #[test]
    fn every_fourth_tick_is_recorded_until_full() {
        let mut trace = Trace::new(4, 10);
        for i in 0..100 {
            let (pose, force) = (Pose::default(), Vector3::zeros());
            trace.record(HapticPoint::new(i, &pose, Buttons::NONE, force));
        }
        assert_eq!(trace.points().len(), 10);
        assert_eq!(trace.points()[9].t_us, 36);
        assert_eq!(trace.lost(), 15);
        assert_eq!(trace.points.capacity(), 10);
    }
}
