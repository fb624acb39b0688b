//! Needles of a shape: touch, the hold of the tissue, and withdrawal.

use super::Reaction;
use super::channel::{Around, Channel, Rod};
use super::contacts::Contacts;
use super::proxy::{Placement, Proxy};
use super::reaction::ShaftReaction;
use super::surface::Surface;
use super::tie::Held;
use crate::{Topology, Vec3};

/// Whether the tissue holds a needle; a blunt tool stays unknown.
#[derive(Clone)]
pub(crate) enum Insertion {
    /// Before its first step.
    Unknown,
    Out,
    In(Channel),
}

impl Insertion {
    pub(crate) fn is_in(&self) -> bool {
        matches!(self, Self::In(_))
    }
}

impl Proxy {
    /// The needle in its pose; `None` for a blunt tool.
    fn rod(&self, spacing_m: f64) -> Option<Rod> {
        self.target.needle?;
        Rod::of(&self.core, self.target.radius_m, spacing_m)
    }

    /// Takes over the state of a needle that another site decides, or that a new tool has.
    pub(super) fn follow_insertion(
        &mut self,
        surface: &Surface<'_>,
        around: &Around<'_>,
        pressed_n: f64,
    ) {
        let Some(needle) = self.target.needle else {
            return;
        };
        if needle.decides && !matches!(self.insertion, Insertion::Unknown) {
            return;
        }
        if !needle.is_inserted {
            self.withdraw();
        } else if !self.insertion.is_in() {
            let spacing = around.topology.model().spacing_m;
            let rod = self.rod(spacing);
            let foot = rod.and_then(|rod| surface.nearest(rod.tip, f64::MAX));
            if let Some((rod, foot)) = rod.zip(foot) {
                let cell = around.topology.exposed.faces[foot.triangle as usize / 2].cell();
                self.insert(Channel::along(around, &rod, cell, pressed_n));
            }
        }
    }

    /// Adds the ties of proxy `i`, an inserted needle.
    pub(super) fn hold(&mut self, around: &Around<'_>, i: usize, to: &mut Vec<Held>) {
        let rod = self.rod(around.topology.model().spacing_m);
        if let (Insertion::In(channel), Some(rod)) = (&mut self.insertion, rod) {
            channel.hold(around, &rod, i as u32, to);
        }
    }

    fn insert(&mut self, channel: Option<Channel>) {
        if let Some(channel) = channel {
            self.secant.clear();
            self.multipliers.clear();
            (self.placement, self.touching, self.gap) = (Placement::Placed, true, 0.0);
            self.insertion = Insertion::In(channel);
        }
    }

    fn withdraw(&mut self) {
        if std::mem::replace(&mut self.insertion, Insertion::Out).is_in() {
            self.secant.clear();
            self.multipliers.clear();
            // Contact begins outside of the surface again.
            (self.placement, self.touching, self.gap) = (Placement::New, false, 0.0);
        }
    }
}

impl Contacts {
    /// The contact of the surface with the tip of proxy `i`.
    fn at_tip(&self, topology: &Topology, u: &[Vec3], i: usize, rod: &Rod) -> Option<TipContact> {
        let proxy = &self.proxies[i];
        let mut found: Option<TipContact> = None;
        for sample in self.samples.iter().filter(|s| s.proxy == i as u32) {
            let (pressed, n) = self.force_over_stiffness(sample, u);
            if pressed > 0.0 && proxy.core.nearest(&sample.position(u))[0] <= -1.0 {
                let contact = found.get_or_insert(TipContact {
                    cell: topology.exposed.faces[sample.triangle as usize / 2].cell(),
                    pressed_n: 0.0,
                });
                contact.pressed_n -= sample.stiffness * pressed * n.dot(&rod.axis);
            }
        }
        found
    }

    /// The force of the tissue on the tip of proxy `i` along its shaft, N.
    pub(super) fn pressed_at_tip_n(&self, topology: &Topology, u: &[Vec3], i: usize) -> f64 {
        let rod = self.proxies[i].rod(topology.model().spacing_m);
        let tip = rod.and_then(|rod| self.at_tip(topology, u, i, &rod));
        tip.map_or(0.0, |tip| tip.pressed_n.max(0.0))
    }

    /// Ends a step for the needle of proxy `i`: the tissue takes hold of it, it cuts, or it leaves. Returns whether the tissue
    /// holds it from now on, by the decision of this shape.
    pub(crate) fn end_insertion(
        &mut self,
        topology: &Topology,
        u: &[Vec3],
        own: &[f64],
        i: usize,
    ) -> bool {
        let spacing = topology.model().spacing_m;
        let Some(rod) = self.proxies[i].rod(spacing) else {
            return false;
        };
        let around = Around { topology, u, own };
        let proxy = &mut self.proxies[i];
        let decides = proxy.target.needle.is_some_and(|needle| needle.decides);
        if let Insertion::In(channel) = &mut proxy.insertion {
            let change = channel.slide(&around, &rod);
            self.is_unsettled |= change.is_unsettled;
            if change.is_out && decides {
                proxy.withdraw();
                self.is_unsettled = true;
            }
            return !change.is_out;
        }
        let tip = self.at_tip(topology, u, i, &rod);
        let Some(tip) = tip.filter(|tip| tip.pressed_n > 0.0) else {
            return false;
        };
        if decides {
            let channel = Channel::along(&around, &rod, tip.cell, tip.pressed_n);
            self.proxies[i].insert(channel);
            self.is_unsettled = true;
            return self.proxies[i].insertion.is_in();
        }
        true
    }

    /// The reaction on the inserted needle of proxy `i`; `None` if it is not inserted.
    pub(super) fn shaft_reaction(
        &self,
        topology: &Topology,
        u: &[Vec3],
        i: usize,
    ) -> Option<Reaction> {
        let proxy = &self.proxies[i];
        let rod = proxy.rod(topology.model().spacing_m)?;
        let Insertion::In(channel) = &proxy.insertion else {
            return None;
        };
        let around = Around {
            topology,
            u,
            own: &[],
        };
        // Forces across the shaft, as two at its ends with the same sum and moment.
        let top_m = channel.entry_m(&around, &rod).max(rod.pitch_m);
        let lever = |along_m: f64| rod.tip + rod.axis * along_m - proxy.at;
        let mut stations = [lever(0.0), lever(top_m)].map(|lever| (lever, Vec3::zeros()));
        let (mut axial_n, mut contacts) = (0.0, 0);
        for held in self.held.iter().filter(|h| h.proxy == i as u32) {
            let force = -held.force(u);
            let along_n = force.dot(&rod.axis);
            let share = rod.axis.dot(&(held.position(u) - rod.tip)) / top_m;
            let across = force - rod.axis * along_n;
            axial_n += along_n;
            stations[0].1 += across * (1.0 - share);
            stations[1].1 += across * share;
            contacts += 1;
        }
        let force = rod.axis * axial_n + stations[0].1 + stations[1].1;
        let torque = stations
            .iter()
            .map(|(lever, f)| lever.cross(f))
            .sum::<Vec3>()
            + lever(0.0).cross(&(rod.axis * axial_n));
        Some(Reaction {
            tool: proxy.id,
            force,
            torque,
            stiffness: proxy.secant.stiffness(),
            normal: rod.axis,
            contacts,
            friction_static: 0.0,
            friction_dynamic: 0.0,
            force_error: 0.0,
            at: proxy.at,
            lag_m: proxy.lag(),
            turn: proxy.turn,
            contact_patches: Vec::new(),
            shaft: Some(ShaftReaction {
                tip: lever(0.0),
                axis: rod.axis,
                axial_n,
                friction_n: channel.friction_n(),
                stations,
            }),
            is_inserted: true,
        })
    }
}

/// The contact of a tip with the surface, before it is held.
struct TipContact {
    /// A cell under the tip.
    cell: u32,
    /// Force on the tip along the shaft, N.
    pressed_n: f64,
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::{Form, Needle, Tool};
    use super::*;
    use crate::{Material, block};

    #[test]
    fn inserted_needle_watches_no_more_after_a_long_way() {
        const D: f64 = 0.004;
        let model = block([8, 8, 8], D, &Material::default(), 1);
        let topology = Topology::new(Arc::new(model));
        let u = vec![Vec3::zeros(); topology.node_count()];
        let own = vec![100.0; u.len()];
        let mut contacts = Contacts::new(&topology);
        for k in 0..500 {
            let x = 4.1 * D + 1e-3 * f64::from(k % 2);
            let tool = Tool {
                form: Form::line(Vec3::zeros(), Vec3::z() * 0.06),
                needle: Some(Needle {
                    is_inserted: true,
                    decides: false,
                }),
                ..Tool::ball(1, Vec3::new(x, 4.1 * D, 4.1 * D), 0.6e-3)
            };
            contacts.begin(&[tool]);
            contacts.gather(&topology, &u, 0.0, &own, &[]);
            assert!(contacts.proxies[0].insertion.is_in());
            assert_eq!(contacts.proxies[0].gap, 0.0);
        }
    }
}
