//! One of a crowd: a session and a hand that moves, without tissue of its own.

use palpate_protocol::handshake::{Hello, Subscription};
use palpate_protocol::session::{ClientEvent, ClientSession};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{ClientTime, Grant, LocalSample, Pose, Role};
use palpate_tissue::Vec3;

use crate::hand::{Hand, Random, Temper};
use crate::tool_location::SurfacePoint;

/// Radius of the ball that everybody holds, m.
const RADIUS_M: f64 = 0.008;

/// How deep who touches presses in the mean, and how far that goes up and down, m.
const DEPTH_M: f64 = 0.005;
const DEPTH_SWING_M: f64 = 0.003;

/// One press and release, s.
const PRESS_PERIOD_S: f64 = 2.5;

/// Speed of a hand that palpates, rms, m/s, along the surface and across it.
const PALPATING_M_S: f64 = 0.01;

/// How far above the surface who does not touch moves, m: more than the hand wanders.
const ABOVE_M: f64 = 0.15;

/// The motion of one hand.
#[derive(Debug, Clone)]
pub(crate) struct Motion {
    spot: SurfacePoint,
    touches: bool,
    hand: Random,
    /// Share of a press at which it begins, so that not all press at once.
    phase: f64,
}

impl Motion {
    /// Of a hand over a spot.
    pub(crate) fn new(spot: SurfacePoint, touches: bool, seed: u64) -> Self {
        let temper = if touches {
            Temper {
                speed_rms_m_s: PALPATING_M_S,
                ..Temper::default()
            }
        } else {
            Temper::default()
        };
        Self {
            spot,
            touches,
            hand: Random::new(temper, seed),
            phase: (seed % 97) as f64 / 97.0,
        }
    }

    /// Where the tool is, `t_s` seconds after the beginning.
    pub(crate) fn at(&self, t_s: f64) -> Pose {
        let wander = Vec3::from(self.hand.at(t_s).position_m);
        let height = if self.touches {
            let turn = std::f64::consts::TAU * (t_s / PRESS_PERIOD_S + self.phase);
            RADIUS_M - DEPTH_M - DEPTH_SWING_M * turn.sin()
        } else {
            ABOVE_M
        };
        // Along the normal a hand that presses is as steady as its tremor.
        let wander = if self.touches {
            wander - self.spot.normal * (0.9 * wander.dot(&self.spot.normal))
        } else {
            wander
        };
        Pose {
            position_m: (self.spot.at + self.spot.normal * height + wander).into(),
            ..Pose::IDENTITY
        }
    }

    /// One sample, as a device of 1 kHz gives it.
    pub(crate) fn sample(&self, time: ClientTime, t_s: f64) -> LocalSample {
        LocalSample {
            time,
            pose: self.at(t_s),
            buttons: 0,
            force_n: Some(if self.touches {
                self.spot.normal.into()
            } else {
                [0.0; 3]
            }),
        }
    }
}

/// What somebody of the crowd says when they come.
pub(crate) fn hello(seat: usize, grant: Grant) -> Hello {
    Hello {
        name: format!("member-{}", seat + 1),
        role: Role::Trainee,
        grant,
        tool: Some(ToolDescription::probe(RADIUS_M)),
        resume: None,
        subscription: Subscription::Full,
    }
}

/// Somebody of the crowd in virtual time.
pub(super) struct Member {
    pub(super) session: ClientSession,
    motion: Motion,
    is_in: bool,
    pub(super) trouble: Option<String>,
}

impl Member {
    pub(super) fn new(
        seat: usize,
        grant: Grant,
        motion: Motion,
        now: ClientTime,
    ) -> Result<Self, String> {
        Ok(Self {
            session: ClientSession::new(hello(seat, grant), now).map_err(|e| e.to_string())?,
            motion,
            is_in: false,
            trouble: None,
        })
    }

    /// One millisecond of its life; what it has to send is to be polled from its session.
    pub(super) fn turn(&mut self, now: ClientTime, t_s: f64) {
        while let Some(event) = self.session.poll_event() {
            match event {
                ClientEvent::Welcomed(_) => self.is_in = true,
                ClientEvent::Closed(reason) => {
                    self.trouble.get_or_insert(reason.to_string());
                }
                _ => {}
            }
        }
        if self.is_in {
            self.session.send_motion(self.motion.sample(now, t_s));
        }
        if self.session.poll_timeout().is_some_and(|due| due <= now) {
            self.session.handle_timeout(now);
        }
    }

    /// Whether it has been let in and knows the server's clock.
    pub(super) fn is_settled(&self) -> bool {
        self.is_in && self.session.clock().is_some()
    }
}
