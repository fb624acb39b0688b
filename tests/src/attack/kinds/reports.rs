//! Attacks with false delay reports.

use std::sync::Arc;
use std::time::Duration;

use palpate_protocol::JoinLink;
use palpate_protocol::tool::ToolDescription;
use tokio::time::sleep;

use super::{AGAIN, Target};
use crate::attack::raw_client::{RawClient, hello};

/// The reported requirement, just below the cap of 400 ms, and the time between two reports.
pub(super) const WANTED: Duration = Duration::from_millis(399);
const REPORT_EVERY: Duration = Duration::from_millis(100);

async fn report(target: &Target, link: &JoinLink, tool: Option<ToolDescription>) {
    loop {
        let hello = hello(link, format!("delay-{}", link.role), tool);
        let joined = RawClient::join(link, hello).await;
        target.count_join(&joined);
        if let Ok(mut client) = joined {
            while client.drain(REPORT_EVERY).await.is_ok() {
                if client.report(WANTED) {
                    target.count("reports sent");
                }
            }
            target.count("connections ended by the server");
        }
        sleep(AGAIN).await;
    }
}

/// A spectator with a slow network, as it claims.
pub(super) async fn spectator(target: Arc<Target>) {
    report(&target, &target.spectator, None).await;
}

/// A trainee with a slow network, as it claims.
pub(super) async fn trainee(target: Arc<Target>) {
    report(
        &target,
        &target.trainee,
        Some(ToolDescription::probe(0.005)),
    )
    .await;
}
