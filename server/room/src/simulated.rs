//! A room with synchronous tissue on one thread, for simulated sessions and tests.

use std::ops::{Deref, DerefMut};
use std::sync::Arc;

use palpate_protocol::session::PeerEvent;
use palpate_protocol::{ServerTime, Span};
use palpate_tissue::Model;

use crate::authority::{Authority, Cutter, TickReport, TissueOrder, TissueReport};
use crate::config::RoomConfig;
use crate::room::{PeerKey, Room};

/// A [`Room`] with its tissue. Calling order as for the room, without orders and reports.
pub struct SimulatedRoom {
    room: Room,
    authority: Authority,
    cutter: Cutter,
}

impl SimulatedRoom {
    /// An empty session over a model.
    pub fn new(model: Arc<Model>, config: RoomConfig, now: ServerTime) -> Self {
        let (authority, cutter) = Authority::new(model);
        Self {
            room: Room::new(cutter.hash(), config, now),
            authority,
            cutter,
        }
    }

    /// See [`Room::handle_event`].
    pub fn handle_event(&mut self, peer: PeerKey, event: PeerEvent, now: ServerTime) {
        self.room.handle_event(peer, event, now);
        self.answer(now, &mut || false);
    }

    /// See [`Room::handle_tick`]; `stop` ends the solve early. Returns the statistics of the tick, if one was due.
    pub fn handle_tick(
        &mut self,
        now: ServerTime,
        stop: &mut dyn FnMut() -> bool,
    ) -> Option<TickReport> {
        self.room.handle_tick(now);
        self.answer(now, stop)
    }

    /// Takes a snapshot for newcomers now, instead of after many cuts.
    pub fn take_snapshot(&mut self, now: ServerTime) {
        self.room.handle_report(self.cutter.snapshot(), now);
    }

    /// Connected components of the cells. Visits the whole model.
    pub fn components(&self) -> usize {
        self.cutter.components()
    }

    /// Whether every edge of the boundary belongs to exactly two triangles. Visits the whole surface.
    pub fn boundary_closed(&self) -> bool {
        self.cutter.boundary_closed()
    }

    fn answer(&mut self, now: ServerTime, stop: &mut dyn FnMut() -> bool) -> Option<TickReport> {
        let mut ticked = None;
        while let Some(order) = self.room.poll_order() {
            let report = match order {
                TissueOrder::Settle(settling) => self.authority.settle(&settling, stop),
                TissueOrder::Cut(cut) => {
                    let (report, made) = self.cutter.make(&self.authority.job(&cut));
                    self.room.handle_report(report, now);
                    if let Some(made) = made {
                        self.authority.take_cut(made.finish());
                    }
                    TissueReport::Prepared {
                        author: cut.author,
                        took: Span::ZERO,
                    }
                }
                TissueOrder::Snapshot => self.cutter.snapshot(),
                TissueOrder::Apply { version, at } => {
                    self.authority.apply(version, at);
                    continue;
                }
            };
            if let TissueReport::Settled { tick, .. } = &report {
                ticked = Some(*tick);
            }
            self.room.handle_report(report, now);
        }
        ticked
    }
}

impl Deref for SimulatedRoom {
    type Target = Room;

    fn deref(&self) -> &Room {
        &self.room
    }
}

impl DerefMut for SimulatedRoom {
    fn deref_mut(&mut self) -> &mut Room {
        &mut self.room
    }
}
