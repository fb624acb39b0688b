//! Site of a thin subscriber, which computes no tissue.

use std::sync::Arc;

use palpate_protocol::datagram::Displacements;
use palpate_protocol::handshake::Welcome;
use palpate_protocol::{ClientTime, ServerTime, Span};
use palpate_tissue::Model;

use super::Site;
use crate::replica::{Replica, ThinView};

impl Site {
    /// A site that computes no tissue, for a thin subscription. Only simulated sessions give it a blade, whose hand
    /// has no force.
    pub fn thin(welcome: &Welcome, model: Arc<Model>, blade_length_m: Option<f64>) -> Self {
        Self::with(welcome, Replica::thin(model), blade_length_m)
    }

    /// Whether this site computes no tissue.
    pub fn is_thin(&self) -> bool {
        self.replica.thin_view().is_some()
    }

    /// Passes surface displacements to the thin view; full subscribers ignore them.
    pub(super) fn handle_displacements(&mut self, news: Displacements, now: ClientTime) {
        let s = self.common_time(now).map(|(s, _)| s);
        if let Some(thin) = self.replica.thin_view_mut() {
            thin.receive(news, s);
        }
    }

    /// Displayed time of the view and its total delay: the common time, minus the lag of a thin view.
    pub(super) fn displayed_time(&self, now: ClientTime) -> Option<(ServerTime, Span)> {
        let (s, delay) = self.common_time(now)?;
        let lag = self.replica.thin_view().map_or(Span::ZERO, ThinView::lag);
        Some((s - lag, delay + lag))
    }
}
