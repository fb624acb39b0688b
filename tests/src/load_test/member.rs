//! A participant of a load test: a protocol session and a moving hand, without tissue.

use palpate_protocol::handshake::{Hello, Subscription};
use palpate_protocol::session::ClientEvent;
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{ClientTime, Grant, LocalSample, Pose, Role};
use palpate_tissue::Vec3;

use crate::hand::{Hand, HandParameters, Random};
use crate::simulated_session::SiteClock;
use crate::simulated_session::endpoint::Endpoint;
use crate::simulated_session::host::{GRANT, Host};
use crate::simulated_session::simulation::Participant;
use crate::tool_location::SurfacePoint;

const RADIUS_M: f64 = 0.008;

/// Mean depth of a press and its amplitude, m.
const DEPTH_M: f64 = 0.005;
const DEPTH_SWING_M: f64 = 0.003;
const PRESS_PERIOD_S: f64 = 2.5;

/// Rms speed of a palpating hand along and across the surface, m/s.
const PALPATING_M_S: f64 = 0.01;

/// Height of a tool that does not touch, m; larger than the hand's random motion.
const ABOVE_M: f64 = 0.15;

#[derive(Debug, Clone)]
pub(crate) struct Motion {
    spot: SurfacePoint,
    touches: bool,
    hand: Random,
    /// Initial phase of the press as a share of its period, so presses are not synchronous.
    phase: f64,
}

impl Motion {
    pub(crate) fn new(spot: SurfacePoint, touches: bool, seed: u64) -> Self {
        let parameters = if touches {
            HandParameters {
                speed_rms_m_s: PALPATING_M_S,
                ..HandParameters::default()
            }
        } else {
            HandParameters::default()
        };
        Self {
            spot,
            touches,
            hand: Random::new(parameters, seed),
            phase: (seed % 97) as f64 / 97.0,
        }
    }

    pub(crate) fn at(&self, t_s: f64) -> Pose {
        let wander = Vec3::from(self.hand.at(t_s).position_m);
        let height = if self.touches {
            let turn = std::f64::consts::TAU * (t_s / PRESS_PERIOD_S + self.phase);
            RADIUS_M - DEPTH_M - DEPTH_SWING_M * turn.sin()
        } else {
            ABOVE_M
        };
        // Along the normal, a pressing hand is as steady as its tremor.
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

    /// One sample of a 1 kHz device.
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

pub(crate) fn hello(seat: usize, role: Role, grant: Grant) -> Hello {
    Hello {
        name: format!("member-{}", seat + 1),
        role,
        grant,
        tool: Some(ToolDescription::probe(RADIUS_M)),
        resume: None,
        subscription: Subscription::Full,
    }
}

/// A participant in virtual time.
pub(super) struct Member {
    pub(super) endpoint: Endpoint,
    motion: Motion,
    is_in: bool,
}

impl Member {
    pub(super) fn new(seat: usize, motion: Motion, clock: SiteClock) -> Result<Self, String> {
        Ok(Self {
            endpoint: Endpoint::new(seat, hello(seat, Role::Trainee, GRANT), clock)?,
            motion,
            is_in: false,
        })
    }

    /// Whether it has joined and knows the server's clock.
    pub(super) fn is_settled(&self) -> bool {
        self.is_in && self.endpoint.session.clock().is_some()
    }
}

impl Participant for Member {
    fn endpoint(&mut self) -> &mut Endpoint {
        &mut self.endpoint
    }

    fn take_events(&mut self, _at_us: i64) {
        while let Some(event) = self.endpoint.session.poll_event() {
            match event {
                ClientEvent::Welcomed(_) => self.is_in = true,
                ClientEvent::Closed(reason) => self.endpoint.check(Err(reason)),
                _ => {}
            }
        }
    }

    fn turn(&mut self, at_us: i64, _host: &Host) {
        self.take_events(at_us);
        if self.is_in {
            let now = self.endpoint.clock.at(at_us);
            let sample = self.motion.sample(now, at_us as f64 * 1e-6);
            self.endpoint.session.send_motion(sample);
        }
        self.endpoint.handle_timeout(at_us);
    }
}
