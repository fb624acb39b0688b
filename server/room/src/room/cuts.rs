//! Cuts: from the request over its checks and its preparation to the log.
//!
//! ```text
//! request --shape, tool, log, budgets--> queue --turn--> preparation --charge--> log
//!                                                                             log --due--> snapshot --> log
//! ```

use palpate_protocol::operation::OperationKind;
use palpate_protocol::permission::Permission;
use palpate_protocol::request::{CutRequest, RequestRefusal};
use palpate_protocol::session::PEER_SILENCE;
use palpate_protocol::tool::ToolKind;
use palpate_protocol::{ParticipantId, RequestId, ServerTime, Span};

use super::Room;
use crate::authority::{CutOrder, LoggedCut, RequestedChange, TissueOrder};
use crate::cut_budget::check_shape;
use crate::limits::Limit;

impl Room {
    /// Queues a cut, or refuses it.
    pub(super) fn order_cut(
        &mut self,
        author: ParticipantId,
        request: RequestId,
        cut: CutRequest,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        if let Err(refusal) = self.check_cut(author, &cut, now) {
            match &refusal {
                RequestRefusal::TooMany => self.limits.count(Limit::CutBudget),
                RequestRefusal::LogFull => self.limits.count(Limit::LogFull),
                RequestRefusal::NotAtTool(_) | RequestRefusal::CanNotCut(_) => {
                    self.limits.count(Limit::CutRefused);
                }
                _ => {}
            }
            return Err(refusal);
        }
        self.cut_queue.push(CutOrder {
            author,
            request,
            change: RequestedChange::Cut(cut),
        });
        self.prepare_cuts();
        Ok(())
    }

    fn check_cut(
        &mut self,
        who: ParticipantId,
        cut: &CutRequest,
        now: ServerTime,
    ) -> Result<(), RequestRefusal> {
        let author = self.participants.get_mut(&who);
        let Some(author) = author.filter(|a| a.role.may(Permission::Cut)) else {
            return Err(RequestRefusal::NotAllowed);
        };
        let Some(blade) = author.tool.filter(|t| t.kind == ToolKind::Scalpel) else {
            return Err(RequestRefusal::NotAllowed);
        };
        if author.demotion.is_demoted() {
            return Err(RequestRefusal::Demoted);
        }
        if author.is_muted {
            return Err(RequestRefusal::Muted);
        }
        if self.controls.frozen_from.is_some() {
            return Err(RequestRefusal::Frozen);
        }
        if !self.log.takes_cut(author.cuts.log_used()) {
            return Err(RequestRefusal::LogFull);
        }
        check_shape(cut, &blade)?;
        (author.track.check(&cut.points)).map_err(RequestRefusal::NotAtTool)?;
        if !self.cut_queue.has_room(who) {
            return Err(RequestRefusal::TooMany);
        }
        author.cuts.take(cut, now)
    }

    /// Queues an undo, a redo or a reset, or refuses it.
    pub(super) fn order_return(
        &mut self,
        author: ParticipantId,
        request: RequestId,
        change: RequestedChange,
    ) -> Result<(), RequestRefusal> {
        if !self.log.takes_return() {
            return Err(RequestRefusal::LogFull);
        }
        if !self.cut_queue.has_room(author) {
            return Err(RequestRefusal::TooMany);
        }
        self.cut_queue.push(CutOrder {
            author,
            request,
            change,
        });
        self.prepare_cuts();
        Ok(())
    }

    fn prepare_cuts(&mut self) {
        while let Some(order) = self.cut_queue.poll() {
            self.orders.push_back(TissueOrder::Cut(order));
        }
    }

    /// Counts the strokes, of which each has any number of parts.
    fn count_stroke(&mut self, author: ParticipantId, change: &OperationKind) {
        let OperationKind::Cut(part) = change else {
            return;
        };
        let number = part.number(author);
        let is_open = self
            .participants
            .get_mut(&author)
            .is_some_and(|author| author.latest_stroke.replace(number) == Some(number));
        self.cuts += u64::from(!is_open);
    }

    /// Charges the author of a prepared cut.
    pub(super) fn handle_prepared(&mut self, author: ParticipantId, took: Span, now: ServerTime) {
        self.cut_queue.end(author);
        self.prepare_cuts();
        if let Some(author) = self.participants.get_mut(&author) {
            author.cuts.charge(took, now);
        }
    }

    /// Logs a cut, or sends its refusal.
    pub(super) fn handle_cut(
        &mut self,
        author: ParticipantId,
        request: RequestId,
        result: Result<LoggedCut, RequestRefusal>,
        now: ServerTime,
    ) {
        match result {
            Ok(cut) => {
                let before = self.version();
                self.count_stroke(author, &cut.change);
                self.topology = (cut.version, cut.hash);
                // A cut has the time of its blade, which may be earlier than that of the operation before it. The bound
                // keeps a repeated old cut in the log almost as long as others.
                let at = (cut.blade_at).map_or(now, |at| at.clamp(now - PEER_SILENCE, now));
                let apply = TissueOrder::Apply {
                    version: cut.version,
                    at,
                };
                self.orders.push_back(apply);
                let bytes = self.append_between(author, cut.change, at, before);
                match self.participants.get_mut(&author) {
                    Some(author) => author.cuts.note_log(bytes),
                    None => self.departed_log += bytes,
                }
                if self.log.poll_snapshot_due() {
                    self.orders.push_back(TissueOrder::Snapshot);
                }
            }
            Err(reason) => self.note_refusal(author, request, reason),
        }
    }

    /// Replaces the snapshot for newcomers. The cuts that it covers no longer count.
    pub(super) fn handle_snapshot(&mut self, version: u32, bytes: &[u8]) {
        if !self.log.cover(version, bytes) {
            return self.limits.count(Limit::Snapshot);
        }
        self.departed_log = 0;
        for seat in self.participants.values_mut() {
            seat.cuts.clear_log();
        }
    }
}
