//! What a step under held nodes may begin with: the change of the last one, carried on.
//!
//! A hand that leads nodes moves on much as it moved before, and equilibrium follows it smoothly. So when
//! the held nodes have moved by γ times what they moved before, the shape begins with γ times its last
//! change; what remains to be solved is of second order in the step. (Under tools the share is looked for
//! along the change itself: where a tool has gone does not tell where it still touches.)

use std::collections::BTreeMap;

use crate::Vec3;

/// Cosine between two moves from which on the second one continues the first.
const ALIKE: f64 = 0.7;

/// Where held nodes were and how they moved in the last step.
#[derive(Default)]
pub(super) struct Foresight {
    drivers: Vec<Driver>,
}

struct Driver {
    node: u32,
    at: Vec3,
    by: Vec3,
}

impl Foresight {
    /// Takes in where held nodes are, and where they were led from; gives γ.
    pub(super) fn look(&mut self, held: &[u32], led: &BTreeMap<u32, Vec3>, u: &[Vec3]) -> f64 {
        let (mut both, mut last, mut now) = (0.0, 0.0, 0.0);
        let drivers: Vec<Driver> = held
            .iter()
            .enumerate()
            .map(|(i, &node)| {
                let at = u[node as usize];
                let same = |d: &&Driver| d.node == node;
                let known = self.drivers.get(i).filter(same);
                let known = known.or_else(|| self.drivers.iter().find(same));
                let from = known.map(|d| d.at).or_else(|| led.get(&node).copied());
                let by = from.map_or_else(Vec3::zeros, |from| at - from);
                if let Some(before) = known {
                    both += by.dot(&before.by);
                    last += before.by.norm_squared();
                    now += by.norm_squared();
                }
                Driver { node, at, by }
            })
            .collect();
        self.drivers = drivers;
        if last == 0.0 || both.abs() < ALIKE * (last * now).sqrt() {
            return 0.0;
        }
        both / last
    }
}
