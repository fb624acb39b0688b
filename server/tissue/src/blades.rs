//! The resistance against cutting blades, for pictures: a blade makes no contact while it cuts.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, UnitQuaternion};

use crate::{
    BladePoint, ContactPatch, EdgeResistance, EdgeTrack, Reaction, Tissue, Vec3, edge_resistance,
};

/// The blades that cut, by tool.
#[derive(Debug, Default)]
pub struct Blades {
    tracks: BTreeMap<u32, EdgeTrack>,
    reactions: Vec<Reaction>,
}

impl Blades {
    /// Follows the blades to their places in the newest shape.
    pub fn follow(&mut self, blades: &[(u32, BladePoint)], tissue: &Tissue) {
        (self.tracks).retain(|tool, _| blades.iter().any(|(cutting, _)| cutting == tool));
        self.reactions.clear();
        for (tool, blade) in blades {
            let track = self.tracks.entry(*tool).or_default();
            track.follow(blade);
            let history = tissue.history();
            let edge = edge_resistance(tissue.topology(), tissue.shape(), history, blade, track);
            if edge.newtons > 0.0 && edge.ahead != Vec3::zeros() {
                self.reactions.push(reaction(*tool, blade, &edge));
            }
        }
    }

    /// The resistance against each blade that moves.
    pub fn reactions(&self) -> &[Reaction] {
        &self.reactions
    }
}

/// The resistance against the motion of a blade.
fn reaction(tool: u32, blade: &BladePoint, edge: &EdgeResistance) -> Reaction {
    let force = edge.ahead * -edge.newtons;
    let lever = blade.axis * edge.along_m;
    Reaction {
        tool,
        force,
        torque: lever.cross(&force),
        stiffness: Matrix3::zeros(),
        normal: -edge.ahead,
        contacts: 1,
        friction_static: 0.0,
        friction_dynamic: 0.0,
        force_error: 0.0,
        at: blade.tip,
        lag_m: 0.0,
        turn: UnitQuaternion::identity(),
        contact_patches: vec![ContactPatch {
            number: 0,
            lever,
            force,
            normal: blade.axis,
            pressed: edge.newtons,
            indentation_m: 0.0,
            friction_static: 1.0,
            friction_dynamic: 1.0,
        }],
        shaft: None,
        is_inserted: false,
    }
}
