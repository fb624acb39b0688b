//! The resistance against cutting blades, for pictures: a blade makes no contact while it cuts.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, UnitQuaternion};
use palpate_protocol::ParticipantId;
use palpate_protocol::tool::part_id;
use palpate_tissue::{
    BladePoint, ContactPatch, EdgeResistance, EdgeTrack, Reaction, Tissue, Vec3, edge_resistance,
};

/// The blades that cut.
#[derive(Debug, Default)]
pub(crate) struct Blades {
    tracks: BTreeMap<ParticipantId, EdgeTrack>,
    pub(crate) reactions: Vec<Reaction>,
}

impl Blades {
    /// Follows the blades to their places in the newest shape.
    pub(crate) fn follow(&mut self, blades: &[(ParticipantId, BladePoint)], tissue: &Tissue) {
        (self.tracks).retain(|who, _| blades.iter().any(|(holder, _)| holder == who));
        self.reactions.clear();
        for (who, blade) in blades {
            let track = self.tracks.entry(*who).or_default();
            let edge = edge_resistance(tissue.topology(), tissue.shape(), blade, track);
            if edge.newtons > 0.0 && edge.ahead != Vec3::zeros() {
                self.reactions.push(reaction(*who, blade, &edge));
            }
        }
    }
}

/// The resistance against the motion of a blade.
fn reaction(who: ParticipantId, blade: &BladePoint, edge: &EdgeResistance) -> Reaction {
    let force = edge.ahead * -edge.newtons;
    let lever = blade.axis * edge.along_m;
    Reaction {
        tool: part_id(who, 0),
        force,
        torque: lever.cross(&force),
        stiffness: Matrix3::zeros(),
        normal: -edge.ahead,
        contacts: 1,
        friction_static: 0.0,
        friction_dynamic: 0.0,
        force_error: 0.0,
        at: blade.tip,
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
