//! How much may wait while a hand does.
//!
//! The finer a model is, the more nodes there are in what a press strains: under a sphere 15 mm deep 500 at 4 mm and
//! 3,000 at 2 mm, which took 10 ms. What may wait on the coarse levels is a matter of tolerances, and the time a step
//! may take is not: so tolerances are made wider while more takes part than there is time for, and narrow again when
//! there is room. It goes by what took part, not by a clock: the same steps give the same bits.

/// Nodes that a step of a hand has time for.
const ROOM: f64 = 900.0;
/// An element of the coarse levels, in nodes: what they cost.
const ELEMENT: f64 = 0.25;
/// Part of the room below which tolerances are narrowed again.
const ROOMY: f64 = 0.8;
/// How many times wider tolerances may be made: beyond it is only the contact left.
const WIDEST: f64 = 8.0;

/// How many times more may wait than where there is time for all of it.
#[derive(Clone, Copy)]
pub(super) struct Relief(f64);

impl Relief {
    pub(super) const NONE: Self = Self(1.0);

    /// Takes in what took part in the last step; gives the factor for the next one.
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
    fn it_settles_where_there_is_just_room() {
        let mut relief = Relief::NONE;
        // Half as much takes part when four times as much may wait.
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
