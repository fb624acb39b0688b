//! Attacks with requests on the operations stream.

use std::sync::Arc;
use std::time::Duration;

use palpate_protocol::operation::{BladePoint, OperationKind};
use palpate_protocol::request::{CutRequest, RequestKind, ServerMessage, TimedBladePoint};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{ServerTime, Span, TopologyHash};
use palpate_tissue::Vec3;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep};

use super::{AGAIN, Target};
use crate::attack::raw_client::{RawClient, hello};
use crate::tool_location::SurfacePoint;

/// Points of a stroke, and requested strokes.
const STROKE_POINTS: usize = 22;
const STROKES: usize = 12;

/// Length and half width of the zigzag and depth of the blade, m.
const ZIGZAG_LENGTH_M: f64 = 0.12;
const ZIGZAG_WIDTH_M: f64 = 0.02;
const BLADE_DEPTH_M: f64 = 0.02;

/// Time of a stroke.
const STROKE_TIME: Span = Span::from_millis(1000);

/// Time after the first cut, to see its effect alone, and between the later ones.
const FIRST_ALONE: Duration = Duration::from_secs(2);
const CUT_EVERY: Duration = Duration::from_millis(250);

/// Time between two requests of the slow reader.
const REQUEST_EVERY: Duration = Duration::from_millis(5);

/// A zigzag around a point of the surface that ends at a time.
fn zigzag(spot: &SurfacePoint, end: ServerTime) -> CutRequest {
    let aside = if spot.normal.x.abs() < 0.9 {
        Vec3::x()
    } else {
        Vec3::y()
    };
    let along = spot.normal.cross(&aside).normalize();
    let across = spot.normal.cross(&along);
    let point = |i: usize| {
        let share = i as f64 / (STROKE_POINTS - 1) as f64;
        let side = if i.is_multiple_of(2) { 1.0 } else { -1.0 };
        let tip =
            spot.at + along * (ZIGZAG_LENGTH_M * (share - 0.5)) + across * (ZIGZAG_WIDTH_M * side)
                - spot.normal * BLADE_DEPTH_M;
        TimedBladePoint {
            time: end - Span::from_secs_f64(STROKE_TIME.as_secs_f64() * (1.0 - share)),
            blade: BladePoint {
                tip_m: tip.into(),
                axis: spot.normal.into(),
                depth_m: BLADE_DEPTH_M,
            },
        }
    };
    CutRequest::whole((0..STROKE_POINTS).map(point).collect(), 0.0005)
}

/// A trainee that cuts where its tool never was.
pub(super) async fn cuts(target: Arc<Target>) {
    let tool = ToolDescription::scalpel(5e-4, BLADE_DEPTH_M);
    let hello = hello(&target.trainee, "zigzag".to_owned(), Some(tool));
    let joined = RawClient::join(&target.trainee, hello).await;
    target.count_join(&joined);
    let Ok(mut client) = joined else {
        return;
    };
    let mut requested = 0;
    loop {
        if requested < STROKES {
            let stroke = zigzag(&target.spot(requested), client.server_now());
            if client.request(RequestKind::Cut(stroke)).await.is_err() {
                return target.count("connections ended by the server");
            }
            target.count("cuts requested");
            requested += 1;
        }
        client.heartbeat();
        let wait = if requested == 1 {
            FIRST_ALONE
        } else {
            CUT_EVERY
        };
        let until = Instant::now() + wait;
        while Instant::now() < until {
            // A participant must not be silent for two seconds.
            let step = until.min(Instant::now() + CUT_EVERY);
            client.heartbeat();
            loop {
                match client.next(step).await {
                    Ok(None) => break,
                    Ok(Some(message)) => count_answer(&target, &client, &message),
                    Err(_) => return target.count("connections ended by the server"),
                }
            }
        }
    }
}

fn count_answer(target: &Target, client: &RawClient, message: &ServerMessage) {
    match message {
        ServerMessage::Operation(o)
            if o.author == client.welcome.participant
                && matches!(o.kind, OperationKind::Cut(_)) =>
        {
            target.count("cuts made");
        }
        ServerMessage::RequestRefused(_) => target.count("cuts refused"),
        _ => {}
    }
}

/// A participant that causes answers and does not read them.
pub(super) async fn slow_reader(target: Arc<Target>) {
    let spot = target.spot(0);
    loop {
        let hello = hello(&target.spectator, "slow-reader".to_owned(), None);
        let joined = RawClient::join(&target.spectator, hello).await;
        target.count_join(&joined);
        if let Ok(mut client) = joined {
            let mut due = interval(REQUEST_EVERY);
            due.set_missed_tick_behavior(MissedTickBehavior::Skip);
            for i in 0_u64.. {
                due.tick().await;
                let request = if i.is_multiple_of(2) {
                    RequestKind::Cut(zigzag(&spot, client.server_now()))
                } else {
                    RequestKind::TopologyReport {
                        version: 0,
                        hash: TopologyHash(i),
                    }
                };
                if client.request(request).await.is_err() {
                    break;
                }
                target.count("requests sent");
            }
            target.count("connections ended by the server");
        }
        sleep(AGAIN).await;
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::ServerTime;
    use palpate_protocol::request::RequestKind;
    use palpate_tissue::Vec3;

    use super::{STROKE_POINTS, zigzag};
    use crate::tool_location::SurfacePoint;

    #[test]
    fn zigzag_is_a_valid_request_on_any_side_of_the_body() {
        for normal in [Vec3::x(), -Vec3::y(), Vec3::z()] {
            let at = Vec3::new(0.1, 0.2, 0.3);
            let stroke = zigzag(
                &SurfacePoint { at, normal },
                ServerTime::from_micros(5_000_000),
            );
            assert_eq!(stroke.points.len(), STROKE_POINTS);
            assert!(RequestKind::Cut(stroke).is_valid());
        }
    }
}
