//! What moves a device that no hand holds, and the tool that it carries.

use nalgebra::Vector3;
use palpate_device::backend::replay::{Moment, Motion, MotionError};
use palpate_device::script::Tool;
use palpate_device::{Buttons, Pose, Script, ScriptError};
use palpate_protocol::Role;

use super::{DeviceKind, best};
use crate::{ClientError, JoinOptions};

/// The tool of a motion without a script: a ball of 8 mm radius.
const BALL: Tool = Tool::probe(8e-3);

/// What moves a device, and what it carries.
#[derive(Debug, Clone)]
pub(crate) struct Guide {
    pub(crate) tool: Tool,
    pub(crate) moves: Moves,
}

/// What moves a device.
#[derive(Debug, Clone)]
pub(crate) enum Moves {
    /// A hand that follows it.
    Script(Script),
    /// The device itself was there.
    Motion(Motion),
    /// Whoever holds it.
    Held {
        /// Where the middle of its workspace is put, m; without it a little above the tissue.
        at: Option<Vector3<f64>>,
        /// The best kind that is plugged in.
        best: DeviceKind,
    },
}

impl Guide {
    /// What was asked for; `None` for a role that only looks.
    pub(crate) fn load(options: &JoinOptions, role: Role) -> Result<Option<Self>, ClientError> {
        if !role.has_tool() {
            return Ok(None);
        }
        let script = match &options.script {
            Some(path) => {
                let wrong = |source| ClientError::Script {
                    path: path.clone(),
                    source,
                };
                Some(Script::load(path).map_err(wrong)?)
            }
            None => None,
        };
        let asked = options.device;
        let best = match (&options.motion, &script) {
            (None, _) if asked.is_owned() => Some(asked),
            (None, None) if asked == DeviceKind::Auto => best(&options.sources),
            _ => None,
        };
        if let Some(best) = best {
            return Ok(Some(Self::held(script.as_ref(), best)));
        }
        let guide = match (&options.motion, script) {
            (Some(path), script) => {
                let wrong = |source| ClientError::Motion {
                    path: path.clone(),
                    source,
                };
                Self {
                    tool: script.map_or(BALL, |s| s.tool()),
                    moves: Moves::Motion(Motion::load(path).map_err(wrong)?),
                }
            }
            (None, Some(script)) => Self {
                tool: script.tool(),
                moves: Moves::Script(script),
            },
            (None, None) => return Err(ClientError::NoScript(role)),
        };
        Ok(Some(guide))
    }

    /// A device in somebody's own hand. A script only says which tool it is, and around where it goes.
    pub(crate) fn held(script: Option<&Script>, best: DeviceKind) -> Self {
        let middle = |script: &Script| {
            let first = script.ways()[0].position;
            let ways = script.ways().iter();
            let (min, max) = ways.fold((first, first), |(min, max), way| {
                (min.inf(&way.position), max.sup(&way.position))
            });
            (min + max) / 2.0
        };
        Self {
            tool: script.map_or(BALL, Script::tool),
            moves: Moves::Held {
                at: script.map(middle),
                best,
            },
        }
    }

    /// One at rest in the origin, by a script or a motion.
    pub(crate) fn at_rest(recorded: bool) -> Result<Self, String> {
        let script = || -> Result<Script, ScriptError> {
            Script::resting_probe(Vector3::zeros(), BALL.radius_m)
        };
        let motion = || -> Result<Motion, MotionError> {
            let moment = |t_s| Moment {
                t_s,
                pose: Pose::default(),
                buttons: Buttons::NONE,
            };
            Motion::new(vec![moment(0.0), moment(1.0)])
        };
        let moves = if recorded {
            Moves::Motion(motion().map_err(|e| e.to_string())?)
        } else {
            Moves::Script(script().map_err(|e| e.to_string())?)
        };
        Ok(Self { tool: BALL, moves })
    }
}
