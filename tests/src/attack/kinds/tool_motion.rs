//! Attacks with the motion of tools.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;
use std::time::Duration;

use nalgebra::UnitQuaternion;
use palpate_protocol::datagram::Body;
use palpate_protocol::lateness::Lateness;
use palpate_protocol::tool::{TOOL_LENGTH_MAX_M, ToolDescription, ToolKind};
use palpate_protocol::{Pose, Span, ToolSample, ToolTrack};
use palpate_tissue::Vec3;
use tokio::time::{Instant, sleep};

use super::{AGAIN, Target, at_once};
use crate::attack::raw_client::{RawClient, hello};
use crate::tool_location::SurfacePoint;

/// Time between two datagrams of motion, and samples in each.
const MOTION_EVERY: Duration = Duration::from_millis(4);
const SAMPLES: i64 = 4;

/// Height of a tool that does not touch, m.
const CLEAR_M: f64 = 0.05;

/// Error of the time stamps.
const WRONG_BY: Span = Span::from_millis(400);

/// Plates over the tissue: their height and swing, m, and their swings per second (2.8 m/s at most).
const BIG_TOOLS: usize = 4;
const HOVER_M: f64 = 0.005;
const SWING_M: f64 = 0.045;
const TURNS_PER_S: f64 = 10.0;

/// Motion at one instant: the pose, the offset of the time stamps, and the claimed lateness.
struct Moment {
    pose: Pose,
    offset: Span,
    late: Lateness,
}

/// Above the tissue, which any tool may push away from the hands.
fn clear(spot: &SurfacePoint) -> Pose {
    let at: Vec3 = spot.at + spot.normal * CLEAR_M;
    Pose {
        position_m: at.into(),
        ..Pose::IDENTITY
    }
}

fn honest(pose: Pose) -> Moment {
    Moment {
        pose,
        offset: Span::ZERO,
        late: Lateness::NONE,
    }
}

/// A trainee whose tool moves as `at` says, by the number of the datagram.
async fn moving(
    target: &Target,
    name: &str,
    tool: ToolDescription,
    at: impl Fn(u64) -> Moment + Send,
) {
    loop {
        let hello = hello(&target.trainee, name.to_owned(), Some(tool));
        let joined = RawClient::join(&target.trainee, hello).await;
        target.count_join(&joined);
        if let Ok(mut client) = joined {
            for n in 0.. {
                let Moment { pose, offset, late } = at(n);
                let now = client.server_now();
                let sample = |k: i64| ToolSample {
                    time: now + offset - Span::from_millis(SAMPLES - 1 - k),
                    pose,
                    buttons: 0,
                    force_n: None,
                };
                let track = ToolTrack {
                    participant: client.welcome.participant,
                    samples: (0..SAMPLES).map(sample).collect(),
                    late,
                };
                if client.send(Body::Motion(vec![track])) {
                    target.count("motion datagrams sent");
                }
                let next = Instant::now() + MOTION_EVERY;
                if client.drain(next - Instant::now()).await.is_err() {
                    break;
                }
            }
            target.count("connections ended by the server");
        }
        sleep(AGAIN).await;
    }
}

/// A tool that is at another place in every datagram.
pub(super) async fn jumps(target: Arc<Target>) {
    let places = [0, 1].map(|i| clear(&target.spot(i)));
    let tool = ToolDescription::probe(0.01);
    moving(&target, "jumps", tool, |n| honest(places[(n % 2) as usize])).await;
}

/// Time stamps that are ahead of the server's clock and behind it, with claims that the machine was late.
pub(super) async fn wrong_times(target: Arc<Target>) {
    let pose = clear(&target.spot(0));
    let tool = ToolDescription::probe(0.01);
    moving(&target, "wrong-times", tool, |n| match n / 250 % 3 {
        0 => Moment {
            offset: WRONG_BY,
            ..honest(pose)
        },
        1 => Moment {
            offset: Span::ZERO - WRONG_BY,
            ..honest(pose)
        },
        _ => Moment {
            late: Lateness {
                newest: WRONG_BY,
                oldest: WRONG_BY,
            },
            ..honest(pose)
        },
    })
    .await;
}

/// The largest plates, tangential over the surface, moving to and fro without touching it: every site searches for
/// their first touch. Plates in the tissue would push it away from the hands, as any tool may.
pub(super) async fn big_tools(target: Arc<Target>) {
    at_once(BIG_TOOLS, |i| {
        let target = Arc::clone(&target);
        async move {
            let spot = target.spot(i);
            let tool = ToolDescription {
                kind: ToolKind::Plate,
                radius_m: 1e-3,
                length_m: TOOL_LENGTH_MAX_M,
                width_m: TOOL_LENGTH_MAX_M,
            };
            let turn = UnitQuaternion::rotation_between(&Vec3::z(), &spot.normal);
            let turn = turn.unwrap_or_else(|| UnitQuaternion::new(Vec3::x() * PI));
            let aside = turn * Vec3::x();
            let orientation = turn.coords.into();
            moving(&target, &format!("plate-{i}"), tool, |n| {
                let phase = n as f64 * MOTION_EVERY.as_secs_f64() * TURNS_PER_S * TAU;
                let at = spot.at + spot.normal * HOVER_M + aside * (SWING_M * phase.sin());
                honest(Pose {
                    position_m: at.into(),
                    orientation,
                })
            })
            .await;
        }
    })
    .await;
}
