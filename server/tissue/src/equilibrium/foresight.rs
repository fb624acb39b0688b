//! What a step may begin with: the change of the last one, carried on.
//!
//! A hand that presses moves on much as it moved before, and equilibrium follows it smoothly. So when
//! what drives the shape (touching tools, held nodes) has moved by γ times what it moved before, the
//! shape begins with γ times its last change; what remains to be solved is of second order in the step.

use std::collections::BTreeMap;

use crate::Vec3;
use crate::contact::Contacts;

/// Cosine between two moves from which on the second one continues the first.
const ALIKE: f64 = 0.7;

/// Where drivers were and how they moved in the last step.
#[derive(Default)]
pub(super) struct Foresight {
    drivers: Vec<Driver>,
}

struct Driver {
    /// Whether it is a node, and the number of the tool or node.
    id: (bool, u32),
    at: Vec3,
    by: Vec3,
}

impl Foresight {
    /// Takes in where tools and held nodes are, and where nodes were led from; gives γ.
    pub(super) fn look(
        &mut self,
        contacts: &Contacts,
        held: &[u32],
        led: &BTreeMap<u32, Vec3>,
        u: &[Vec3],
        spacing: f64,
    ) -> f64 {
        let tools = contacts.touching(spacing).map(|(id, at)| ((false, id), at));
        let nodes = held.iter().map(|&n| ((true, n), u[n as usize]));
        let (mut both, mut last, mut now) = (0.0, 0.0, 0.0);
        let drivers: Vec<Driver> = tools
            .chain(nodes)
            .enumerate()
            .map(|(i, (id, at))| {
                let same = |d: &&Driver| d.id == id;
                let known = self.drivers.get(i).filter(same);
                let known = known.or_else(|| self.drivers.iter().find(same));
                let from = || led.get(&id.1).filter(|_| id.0).copied();
                let from = known.map(|d| d.at).or_else(from);
                let by = from.map_or_else(Vec3::zeros, |from| at - from);
                if let Some(before) = known {
                    both += by.dot(&before.by);
                    last += before.by.norm_squared();
                    now += by.norm_squared();
                }
                Driver { id, at, by }
            })
            .collect();
        self.drivers = drivers;
        if last == 0.0 || both.abs() < ALIKE * (last * now).sqrt() {
            return 0.0;
        }
        both / last
    }
}
