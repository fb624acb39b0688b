//! Source of a device's motion (a script, a recording or a user's hand), and the tool that it carries.

use nalgebra::Vector3;
use palpate_device::backend::replay::{Moment, Motion};
use palpate_device::script::Tool;
use palpate_device::{Buttons, HapticDevice, Pose, Script, ScriptError};
use palpate_protocol::Role;
use palpate_tissue::Model;

use super::{DeviceError, DeviceKind, HeldDevice, input, owned};
use crate::{ClientError, JoinOptions};

/// Tool of a recorded motion without a script: a ball of 8 mm radius.
const BALL: Tool = Tool::probe(8e-3);

/// Source of motion and tool of a device.
#[derive(Debug, Clone)]
pub(crate) struct Guide {
    pub(crate) tool: Tool,
    pub(crate) moves: Moves,
}

/// Source of motion of a device.
#[derive(Debug, Clone)]
pub(crate) enum Moves {
    /// A simulated hand follows the script.
    Script(Script),
    /// The device replays the recording.
    Motion(Motion),
    /// The user holds the device.
    Held(HeldDevice),
}

impl Guide {
    /// Loads script or motion as requested; `None` for a role without a tool.
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
        if asked == DeviceKind::Pointer && options.view.is_none() {
            return Err(DeviceError::NeedsView.into());
        }
        let held = match (&options.motion, &script) {
            (None, _) if asked.is_held() => Some(asked),
            // Devices with force feedback take precedence, and a pointer comes last: it is always there.
            (None, None) if asked == DeviceKind::Auto => owned::best(&options.sources)
                .or_else(input::best)
                .or(options.view.map(|_| DeviceKind::Pointer)),
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

    /// A device in the user's hand. A script then only gives the tool and its initial pose.
    pub(crate) fn held(script: Option<&Script>, kind: DeviceKind) -> Self {
        Self {
            tool: script.map_or(BALL, Script::tool),
            moves: Moves::Held(HeldDevice::new(kind, script)),
        }
    }

    /// Whether a device is opened once per session. A motorised device may calibrate then, and its user waits. Other
    /// devices are opened as a check, closed, and opened again when their position is known.
    pub(crate) fn is_opened_once(&self) -> bool {
        matches!(&self.moves, Moves::Held(hold) if hold.kind.is_owned())
    }

    /// Places a held device relative to the tissue.
    pub(crate) fn place_workspace(&mut self, model: &Model) {
        if let Moves::Held(hold) = &mut self.moves {
            hold.place_workspace(model);
        }
    }

    /// A device that was opened once, placed in the scene.
    pub(crate) fn placed(&self, device: Box<dyn HapticDevice>) -> Box<dyn HapticDevice> {
        match &self.moves {
            Moves::Held(hold) => hold.placed(device),
            Moves::Script(_) | Moves::Motion(_) => device,
        }
    }

    /// A guide at rest in the origin, by a script or a motion.
    pub(crate) fn at_rest(recorded: bool) -> Result<Self, String> {
        let script = || -> Result<Script, ScriptError> {
            Script::resting_probe(Vector3::zeros(), BALL.radius_m)
        };
        let motion = || -> Result<Motion, ScriptError> {
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

#[cfg(test)]
mod tests {
    use palpate_device::backend::haply::Service;

    use super::*;
    use crate::Sources;

    /// Options of a machine without devices.
    fn options(device: DeviceKind, has_view: bool) -> JoinOptions {
        JoinOptions {
            device,
            view: has_view.then(|| "127.0.0.1:4481".parse().unwrap()),
            sources: Sources {
                haply: Service {
                    // The discard port, where no service listens.
                    simulation: "ws://127.0.0.1:9".to_owned(),
                    events: None,
                },
                libhd: Some("nowhere/libHD.so".into()),
                libdrd: Some("nowhere/libdrd.so".into()),
            },
            ..JoinOptions::new("L", "Ada")
        }
    }

    fn held(options: &JoinOptions) -> Option<DeviceKind> {
        let guide = Guide::load(options, Role::Trainee).unwrap().unwrap();
        match guide.moves {
            Moves::Held(hold) => {
                assert_eq!(guide.tool, BALL);
                Some(hold.kind)
            }
            Moves::Script(_) | Moves::Motion(_) => None,
        }
    }

    #[test]
    fn pointer_needs_a_view() {
        let pointer = |has_view| options(DeviceKind::Pointer, has_view);
        let error = Guide::load(&pointer(false), Role::Trainee).unwrap_err();
        assert!(matches!(error, ClientError::Device(DeviceError::NeedsView)));
        assert_eq!(held(&pointer(true)), Some(DeviceKind::Pointer));
        // A role without a tool opens no device.
        assert!(
            Guide::load(&pointer(false), Role::Spectator)
                .unwrap()
                .is_none()
        );
    }

    #[test]
    fn auto_chooses_pointer_only_with_a_view_and_nothing_else_that_moves() {
        let auto = |has_view| options(DeviceKind::Auto, has_view);
        assert_eq!(held(&auto(true)), Some(DeviceKind::Pointer));
        let error = Guide::load(&auto(false), Role::Trainee).unwrap_err();
        assert!(matches!(error, ClientError::NoScript(_)), "{error}");
        let folder = tempfile::tempdir().unwrap();
        let (script, motion) = (folder.path().join("s.toml"), folder.path().join("m.csv"));
        let text = "format = \"palpate-script/1\"\n[tool]\nkind = \"probe\"\nradius_mm = 6.0\n\
            [[way]]\nt_s = 0.0\nat_mm = [0.0, 0.0, 0.0]\n[[way]]\nt_s = 1.0\nat_mm = [1.0, 0.0, 0.0]\n";
        std::fs::write(&script, text).unwrap();
        std::fs::write(&motion, "t_s,x_m,y_m,z_m\n0,0,0,0\n1,0,0,0\n").unwrap();
        let scripted = JoinOptions {
            script: Some(script),
            ..auto(true)
        };
        assert_eq!(held(&scripted), None);
        let recorded = JoinOptions {
            motion: Some(motion),
            ..auto(true)
        };
        assert_eq!(held(&recorded), None);
    }
}
