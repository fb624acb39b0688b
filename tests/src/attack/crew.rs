//! The attackers of a run, on a thread of this process.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use palpate_transport::threads;
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;

use super::kinds::{Attack, Counts, Target};
use crate::headless_page::PageAddress;
use crate::session::{Session, SessionError};
use crate::tool_location::SurfacePoint;

/// Maximum time for the remaining work of a runtime that ends.
const END_WITHIN: Duration = Duration::from_millis(500);

/// Running attacks.
pub(super) struct Crew {
    runtime: Option<Runtime>,
    attacks: Vec<(Attack, Arc<Target>, JoinHandle<()>)>,
}

impl Crew {
    /// Starts all attacks at once.
    pub(super) fn start(
        attacks: &[Attack],
        session: &Session,
        spots: &[SurfacePoint],
    ) -> Result<Self, SessionError> {
        let trainee = session.direct_link("trainee")?;
        let spectator = session.direct_link("spectator")?;
        let page = |(role, url): (&String, &String)| Some((role.clone(), PageAddress::parse(url)?));
        let pages: BTreeMap<String, PageAddress> =
            session.listening.pages.iter().filter_map(page).collect();
        // Attackers stand for other machines: they do not preempt the threads of the session here.
        let runtime = threads::background_runtime().map_err(SessionError::Runtime)?;
        let start = |attack: &Attack| {
            let target = Target::new(
                trainee.clone(),
                spectator.clone(),
                spots.to_vec(),
                pages.clone(),
            );
            let target = Arc::new(target);
            let task = runtime.spawn(attack.run(Arc::clone(&target)));
            (*attack, target, task)
        };
        Ok(Self {
            attacks: attacks.iter().map(start).collect(),
            runtime: Some(runtime),
        })
    }

    /// Stops all attackers; their connections are dropped.
    pub(super) fn stop(&self) {
        for (_, _, task) in &self.attacks {
            task.abort();
        }
    }

    /// Counters of each attack.
    pub(super) fn counts(&self) -> Vec<(&'static str, Counts)> {
        let of = |(attack, target, _): &(Attack, Arc<Target>, JoinHandle<()>)| {
            (attack.name, target.counts())
        };
        self.attacks.iter().map(of).collect()
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(END_WITHIN);
        }
    }
}
