//! Pages of spectators that keep to the format: a load on the server.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::time::{sleep, timeout};

use super::{AGAIN, Target, at_once};
use crate::headless_page::{Arrived, HeadlessPage, PageAddress, PageError, Received};

/// Number of pages.
const PAGES: usize = 50;

/// Time between two joins: a server admits ten spectators per second.
const JOIN_EVERY: Duration = Duration::from_millis(100);

/// All pages have joined after this time, also those that tried twice.
pub(super) const JOINED_WITHIN: Duration = Duration::from_secs(8);

/// A page misses the tissue if no shape arrives for this long. A cut takes up to 0.5 s of preparation beside the ticks, and
/// the page is served at background priority.
const SHAPE_WITHIN: Duration = Duration::from_secs(2);

pub(super) const BROKEN: &str = "broken shapes";
pub(super) const LATE: &str = "times that a page had no shape for 2 s";
pub(super) const ENDED: &str = "honest pages ended by the server";

/// Events that must not happen to an honest page.
pub(super) const FORBIDDEN: &[&str] = &[BROKEN, LATE, ENDED];

/// Pages that join one after the other and stay.
pub(super) async fn pages(target: Arc<Target>) {
    let Some(address) = target.page("spectator") else {
        return;
    };
    at_once(PAGES, |i| {
        let (target, address) = (Arc::clone(&target), address.clone());
        async move {
            sleep(JOIN_EVERY * i as u32).await;
            stay(&target, &address, &format!("page-{i}")).await;
        }
    })
    .await;
}

/// Joins, and watches until it is dropped.
pub(super) async fn stay(target: &Target, address: &PageAddress, name: &str) {
    for attempt in 0_u32.. {
        match HeadlessPage::join(address, &format!("{name}-{attempt}"), None).await {
            Ok(page) => {
                target.count("joined");
                let _ = watch(target, page).await;
                target.count(ENDED);
            }
            Err(PageError::Refused(_)) => target.count("refused to join"),
            Err(_) => target.count("failed to join"),
        }
        sleep(AGAIN).await;
    }
}

/// Reads everything until the connection ends.
async fn watch(target: &Target, mut page: HeadlessPage) -> Result<(), PageError> {
    let mut newest = Instant::now();
    loop {
        // A host that sends nothing at all is noticed as well.
        let received = timeout(SHAPE_WITHIN, page.next()).await;
        if newest.elapsed() > SHAPE_WITHIN {
            target.count(LATE);
            newest = Instant::now();
        }
        let Ok(received) = received else {
            continue;
        };
        match received? {
            Received::Text(text) if text["type"] == "pong" => target.count("pongs"),
            Received::Frame(Arrived::Shape(shape)) => {
                target.count(if shape.is_full {
                    "full shapes"
                } else {
                    "changes"
                });
                let gap_ms = newest.elapsed().as_millis() as u64;
                target.largest("ms without a shape at most", gap_ms);
                newest = Instant::now();
            }
            Received::Frame(Arrived::Broken(why)) => {
                target.count(why);
                target.count(BROKEN);
            }
            Received::Text(_) | Received::Frame(_) => {}
        }
    }
}
