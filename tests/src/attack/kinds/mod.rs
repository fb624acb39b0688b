//! The attacks. To add one: write `async fn name(target: Arc<Target>)`, which runs until it is dropped, counts what
//! it achieves with `Target::count`, and sleeps between its steps; then add a row to [`ALL`].

mod bad_pages;
mod connections;
mod half_open;
mod joins;
mod names;
mod pages;
mod reports;
mod requests;
mod spectators;
mod tool_motion;

use std::collections::BTreeMap;
use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use palpate_protocol::JoinLink;
use tokio::task::JoinSet;

use super::raw_client::JoinError;
use crate::headless_page::PageAddress;
use crate::name_suggestion::did_you_mean;
use crate::tool_location::SurfacePoint;

/// Pause before an attacker tries again after a refusal or the end of its connection.
const AGAIN: Duration = Duration::from_secs(1);

type Running = Pin<Box<dyn Future<Output = ()> + Send>>;

/// An attack.
#[derive(Clone, Copy)]
pub struct Attack {
    /// Name on the command line.
    pub name: &'static str,
    /// Description in one line.
    pub about: &'static str,
    /// Whether attackers keep all seats of spectators.
    pub(super) takes_seats: bool,
    /// The pages that it needs; most attacks need none.
    pub(super) pages: Option<Pages>,
    /// Counts of events that must not happen.
    pub(super) forbidden: &'static [&'static str],
    run: fn(Arc<Target>) -> Running,
}

/// A session with a page.
#[derive(Clone, Copy)]
pub(super) struct Pages {
    /// Number of seats, and of those among them that spectators may take.
    pub(super) seats: [u16; 2],
    /// Time from the begin of the attack to the joins of the honest trainees.
    pub(super) lead: Duration,
}

/// All attacks in the order in which they run.
pub const ALL: &[Attack] = &[
    Attack {
        name: "transfers",
        about: "16 connections to the model transfer send one byte each and wait",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(connections::transfers(t, 16)),
    },
    Attack {
        name: "transfers-150",
        about: "150 connections to the model transfer send one byte each and wait",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(connections::transfers(t, 150)),
    },
    Attack {
        name: "handshakes",
        about: "100 half-open handshakes per second from one address",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(connections::handshakes(t)),
    },
    Attack {
        name: "cut",
        about: "a trainee requests 12 cuts of 22 points in a zigzag, where its tool never was",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(requests::cuts(t)),
    },
    Attack {
        name: "tools",
        about: "8 trainees drop and resume with another tool, to fill the operation log",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(joins::tools(t)),
    },
    Attack {
        name: "delay",
        about: "a spectator reports a delay requirement of 399 ms every 100 ms",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(reports::spectator(t)),
    },
    Attack {
        name: "delay-trainee",
        about: "a trainee reports a delay requirement of 399 ms every 100 ms",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(reports::trainee(t)),
    },
    Attack {
        name: "seats",
        about: "spectators join and drop 16 times in 2.5 s, again and again",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(joins::seats(t)),
    },
    Attack {
        name: "slow-reader",
        about: "a spectator never reads its stream and sends 200 requests per second",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(requests::slow_reader(t)),
    },
    Attack {
        name: "names",
        about: "spectators join under names that look like that of another participant",
        takes_seats: false,
        pages: None,
        forbidden: &[names::ACCEPTED],
        run: |t| Box::pin(names::names(t)),
    },
    Attack {
        name: "spectators",
        about: "100 attackers with spectator links join, drop, report, probe and never read",
        takes_seats: true,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(spectators::spectators(t)),
    },
    Attack {
        name: "poses",
        about: "a trainee's tool jumps between two places in the tissue, 250 times per second",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(tool_motion::jumps(t)),
    },
    Attack {
        name: "future",
        about: "a trainee stamps its samples 0.4 s ahead and 0.4 s late in turn, and claims lateness",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(tool_motion::wrong_times(t)),
    },
    Attack {
        name: "big-tools",
        about: "four trainees swing the largest plates close over the tissue, ten times per second",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(tool_motion::big_tools(t)),
    },
    Attack {
        name: "flapping",
        about: "four trainees resume their seats over a new connection ten times per second",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(joins::flapping(t)),
    },
    Attack {
        name: "flood",
        about: "four spectators send as many datagrams as the transport allows",
        takes_seats: false,
        pages: None,
        forbidden: &[],
        run: |t| Box::pin(spectators::flood(t)),
    },
    Attack {
        name: "pages",
        about: "50 pages of spectators read everything, ping twice a second and check every shape",
        takes_seats: false,
        pages: Some(Pages {
            seats: [64, 60],
            lead: pages::JOINED_WITHIN,
        }),
        forbidden: pages::FORBIDDEN,
        run: |t| Box::pin(pages::pages(t)),
    },
    Attack {
        name: "bad-pages",
        about: "pages flood, send 10 MB, NaN poses and markup, never read and reconnect, beside an honest page",
        takes_seats: false,
        pages: Some(Pages {
            seats: [64, 60],
            lead: Duration::ZERO,
        }),
        forbidden: bad_pages::FORBIDDEN,
        run: |t| Box::pin(bad_pages::bad_pages(t)),
    },
];

impl Attack {
    /// The attack with this name.
    ///
    /// # Errors
    ///
    /// A message with the nearest known name.
    pub fn named(name: &str) -> Result<Self, String> {
        let known: Vec<&str> = ALL.iter().map(|a| a.name).collect();
        let found = ALL.iter().find(|a| a.name == name).copied();
        found.ok_or_else(|| {
            format!(
                "unknown attack \"{name}\"{}; `palpate-lab attack --list` names all",
                did_you_mean(name, &known)
            )
        })
    }

    /// Runs until it is dropped.
    pub(super) fn run(&self, target: Arc<Target>) -> Running {
        (self.run)(target)
    }
}

impl std::fmt::Debug for Attack {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name)
    }
}

/// Counts of what an attack achieved, by description.
pub(super) type Counts = BTreeMap<&'static str, u64>;

/// The server under attack, and the counts of one attack.
pub(super) struct Target {
    /// Links of the server, without an emulated network.
    pub(super) trainee: JoinLink,
    pub(super) spectator: JoinLink,
    /// Points on the surface of the tissue; at least one.
    pub(super) spots: Vec<SurfacePoint>,
    /// Addresses of the page by role; none in a session without pages.
    pages: BTreeMap<String, PageAddress>,
    counts: Mutex<Counts>,
    /// Names given so far.
    names: AtomicU64,
}

impl Target {
    pub(super) fn new(
        trainee: JoinLink,
        spectator: JoinLink,
        spots: Vec<SurfacePoint>,
        pages: BTreeMap<String, PageAddress>,
    ) -> Self {
        Self {
            trainee,
            spectator,
            spots,
            pages,
            counts: Mutex::default(),
            names: AtomicU64::new(0),
        }
    }

    /// Counts an event.
    pub(super) fn count(&self, what: &'static str) {
        self.add(what, 1);
    }

    fn add(&self, what: &'static str, n: u64) {
        // A panicked task leaves complete counts behind.
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        *counts.entry(what).or_default() += n;
    }

    /// A number for a name, once.
    fn number(&self) -> u64 {
        self.names.fetch_add(1, Ordering::Relaxed)
    }

    /// Keeps the largest of all values as the count.
    fn largest(&self, what: &'static str, n: u64) {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        let count = counts.entry(what).or_default();
        *count = n.max(*count);
    }

    /// The address of the page for a role.
    fn page(&self, role: &str) -> Option<PageAddress> {
        self.pages.get(role).cloned()
    }

    /// Counts the result of an attempt to join.
    fn count_join<T>(&self, result: &Result<T, JoinError>) {
        self.count(match result {
            Ok(_) => "joined",
            Err(JoinError::Refused(_)) => "refused to join",
            Err(JoinError::Failed(_)) => "failed to join",
        });
    }

    /// The counts so far.
    pub(super) fn counts(&self) -> Counts {
        let counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        counts.clone()
    }

    fn spot(&self, i: usize) -> SurfacePoint {
        self.spots[i % self.spots.len()]
    }
}

/// Runs `n` attackers at once, each until all are dropped.
async fn at_once<F>(n: usize, attacker: impl Fn(usize) -> F)
where
    F: Future<Output = ()> + Send + 'static,
{
    let mut all = JoinSet::new();
    for i in 0..n {
        all.spawn(attacker(i));
    }
    while all.join_next().await.is_some() {}
}

#[cfg(test)]
mod tests {
    use super::{ALL, Attack};

    #[test]
    fn attack_names_are_unique_and_misspelt_ones_get_a_suggestion() {
        for attack in ALL {
            let same = ALL.iter().filter(|a| a.name == attack.name).count();
            assert_eq!(same, 1, "{attack:?}");
            assert_eq!(Attack::named(attack.name).unwrap().about, attack.about);
            assert!(!attack.about.contains('\n') && attack.about.len() < 100);
        }
        let error = Attack::named("handshake").unwrap_err();
        assert!(error.contains("did you mean \"handshakes\"?"), "{error}");
        assert!(Attack::named("").is_err());
    }
}
