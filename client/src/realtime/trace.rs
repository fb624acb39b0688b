//! Recorded poses and forces of a run, for plots and comparisons.

use crate::recording::HapticPoint;

/// Every n-th tick of a run and each change of buttons, in preallocated memory. A replayed blade then cuts from the same tick
/// on.
#[derive(Debug, Clone, Default)]
pub struct Trace {
    points: Vec<HapticPoint>,
    capacity: usize,
    every: u32,
    skipped: u32,
    buttons: u32,
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
            buttons: 0,
            lost: 0,
        }
    }

    /// Records every n-th `point`, and those with other buttons than before, while there is room. Never allocates.
    pub(super) fn record(&mut self, point: HapticPoint) {
        if self.every == 0 {
            return;
        }
        let is_changed = std::mem::replace(&mut self.buttons, point.buttons) != point.buttons;
        let is_due = self.skipped == 0;
        self.skipped = if is_due { self.every } else { self.skipped } - 1;
        if !is_due && !is_changed {
            return;
        }
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

    #[test]
    fn changes_of_buttons_are_recorded_between() {
        let mut trace = Trace::new(4, 10);
        for i in 0..10 {
            let held = (5..7).contains(&i);
            let buttons = Buttons::from_bits(held.into());
            let (pose, force) = (Pose::default(), Vector3::zeros());
            trace.record(HapticPoint::new(i, &pose, buttons, force));
        }
        let times: Vec<i64> = trace.points().iter().map(|p| p.t_us).collect();
        assert_eq!(times, [0, 4, 5, 7, 8]);
    }
}
