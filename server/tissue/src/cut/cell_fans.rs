//! Fans: the cells around a node, grouped by whether one can pass from one to the other through
//! faces at that node that are not open.
//!
//! A node is corner `s` of the cell in its slot `s`, so its cells sit on the corners of a cube whose
//! edges are the faces between them. Each fan gets a node of its own when a cut is applied.

use std::collections::HashMap;

use crate::cell::NO_CELL;
use crate::{FaceId, Topology};

/// Fan of each slot of a node: the lowest slot in it, or [`NO_FAN`] for an empty slot.
pub(crate) type Fans = [u8; 8];
/// Fan of an empty slot.
pub(crate) const NO_FAN: u8 = u8::MAX;

/// A topology with some more faces open than it has.
pub(crate) struct Opening<'a> {
    pub(crate) topology: &'a Topology,
    /// Bits of the additional open faces of a cell; both sides of a face are in it.
    mask: HashMap<u32, u8>,
}

impl<'a> Opening<'a> {
    pub(crate) fn new(topology: &'a Topology, faces: &[FaceId]) -> Self {
        let mut opening = Self {
            topology,
            mask: HashMap::new(),
        };
        for &face in faces {
            for side in opening.both(face) {
                *opening.mask.entry(side.cell()).or_default() |= 1 << side.face();
            }
        }
        opening
    }

    pub(crate) fn close(&mut self, face: FaceId) {
        for side in self.both(face) {
            if let Some(mask) = self.mask.get_mut(&side.cell()) {
                *mask &= !(1 << side.face());
            }
        }
    }

    fn both(&self, face: FaceId) -> [FaceId; 2] {
        [face, self.topology.behind(face)]
    }

    /// Whether a face is one of the additional open ones.
    pub(crate) fn is_new(&self, face: FaceId) -> bool {
        self.mask
            .get(&face.cell())
            .is_some_and(|mask| mask >> face.face() & 1 == 1)
    }

    /// The cell behind a face, or [`NO_CELL`] where it is outside or open.
    pub(crate) fn across(&self, face: FaceId) -> u32 {
        if self.is_new(face) {
            NO_CELL
        } else {
            self.topology.across(face)
        }
    }

    pub(crate) fn fans(&self, node: u32) -> Fans {
        let cells = self.topology.node_cells[node as usize];
        let mut fan: Fans =
            std::array::from_fn(|s| if cells[s] == NO_CELL { NO_FAN } else { s as u8 });
        for axis in 0..3 {
            let bit = 1 << axis;
            for s in (0..8).filter(|s| s & bit != 0) {
                let (from, to) = (cells[s], cells[s ^ bit]);
                if from == NO_CELL || to == NO_CELL || fan[s] == fan[s ^ bit] {
                    continue;
                }
                if self.across(FaceId::new(from, 2 * axis + 1)) == to {
                    let (a, b) = (fan[s].min(fan[s ^ bit]), fan[s].max(fan[s ^ bit]));
                    for f in &mut fan {
                        if *f == b {
                            *f = a;
                        }
                    }
                }
            }
        }
        fan
    }
}

impl Topology {
    /// The same face of the model as built, seen from the cell behind it, open or not. Only for
    /// faces that have a cell behind.
    pub(crate) fn behind(&self, face: FaceId) -> FaceId {
        let cell = self.model.cells[face.cell() as usize].neighbours[face.face()];
        FaceId::new(cell, face.face() ^ 1)
    }
}
