//! What moves a device (a script, a motion or a hand), and the tool that it carries.

use nalgebra::Vector3;
use palpate_device::backend::replay::{Moment, Motion, MotionError};
use palpate_device::script::Tool;
use palpate_device::{Buttons, HapticDevice, Pose, Script, ScriptError};
use palpate_protocol::Role;
use palpate_tissue::Model;

use super::{DeviceKind, Hold, input, owned};
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
    Held(Hold),
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
        let held = match (&options.motion, &script) {
            (None, _) if asked.is_held() => Some(asked),
            // What renders force comes before what does not.
            (None, None) if asked == DeviceKind::Auto => {
                owned::best(&options.sources).or_else(input::best)
            }
            _ => None,
        };
        if let Some(kind) = held {
            return Ok(Some(Self::held(script.as_ref(), kind)));
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

    /// A device in somebody's own hand. A script only says which tool it is, and where.
    pub(crate) fn held(script: Option<&Script>, kind: DeviceKind) -> Self {
        Self {
            tool: script.map_or(BALL, Script::tool),
            moves: Moves::Held(Hold::new(kind, script)),
        }
    }

    /// Whether a device is opened once for a whole session: one with motors may calibrate then, and who holds it waits.
    /// Any other is opened to see that it can be, closed, and opened again when it is known where it is.
    pub(crate) fn is_opened_once(&self) -> bool {
        matches!(&self.moves, Moves::Held(hold) if hold.kind.is_owned())
    }

    /// Tells a hand where the tissue is.
    pub(crate) fn find_place(&mut self, model: &Model) {
        if let Moves::Held(hold) = &mut self.moves {
            hold.find_place(model);
        }
    }

    /// A device that was opened once, put into the scene.
    pub(crate) fn placed(&self, device: Box<dyn HapticDevice>) -> Box<dyn HapticDevice> {
        match &self.moves {
            Moves::Held(hold) => hold.placed(device),
            Moves::Script(_) | Moves::Motion(_) => device,
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
