//! The JSON messages between page and host, see `WIRE.md`.

use std::collections::BTreeMap;
use std::fmt;

use palpate_protocol::control::Control;
use palpate_protocol::name::NameError;
use palpate_protocol::tool::{ToolDescription, ToolKind};
use palpate_protocol::{Grant, ParticipantId, ResumeToken, Role};
use serde::{Deserialize, Serialize};

use crate::control_message::{AnnotationMessage, CameraMessage, ControlMessage, EmulationMessage};

/// Version of the format.
pub(crate) const VERSION: u32 = 1;

/// A text message of a page.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum FromPage {
    Hello(HelloMessage),
    Ping { id: u32, sent_ms: f64 },
    Tool { tool: ToolMessage },
    Control(ControlMessage),
    Springs { region: Option<u16> },
    Leave,
}

/// The first message of a page.
#[derive(Debug, Clone, Deserialize)]
pub(crate) struct HelloMessage {
    version: u32,
    #[serde(default)]
    name: String,
    role: Option<String>,
    grant: String,
    tool: Option<ToolMessage>,
    seat: Option<Seat>,
}

/// The seat that a page takes again after its connection was lost.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Seat {
    /// The participant.
    pub participant: u16,
    /// Its token, hexadecimal.
    pub token: String,
}

impl Seat {
    /// The seat in a message.
    pub fn new(participant: ParticipantId, token: ResumeToken) -> Self {
        Self {
            participant: participant.0,
            token: data_encoding::HEXLOWER_PERMISSIVE.encode(&token.0),
        }
    }
}

/// The request of a page that opens.
#[derive(Debug, Clone, PartialEq)]
pub struct PageHello {
    /// Name of the participant; empty to a local client.
    pub name: String,
    /// Role; `None` to a local client.
    pub role: Option<Role>,
    /// The secret of the page's URL.
    pub grant: Grant,
    /// The tool, of a role that has one.
    pub tool: Option<ToolDescription>,
    /// The seat to take again.
    pub seat: Option<(ParticipantId, ResumeToken)>,
}

/// A request of a page.
#[derive(Debug, Clone, PartialEq)]
pub enum PageRequest {
    /// Another tool.
    Tool(ToolDescription),
    /// A control of the instructor.
    Control(Control),
    /// Leave the session.
    Leave,
}

/// A message that no host can use.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum MessageError {
    #[error("a message that is not in the page's format: {0}")]
    Format(String),
    #[error("the page has version {0} of the format and the host {VERSION}; reload the page")]
    Version(u32),
    #[error("the grant is not 32 hexadecimal digits; open the whole link")]
    Grant,
    #[error("{0}")]
    Role(String),
    #[error("the size of the tool is out of range: {0}")]
    Tool(String),
    #[error("a number or text of the control is out of range")]
    Control,
    #[error("{0}")]
    Name(#[from] NameError),
}

impl FromPage {
    pub(crate) fn parse(text: &str) -> Result<Self, MessageError> {
        serde_json::from_str(text).map_err(|e| MessageError::Format(e.to_string()))
    }
}

impl HelloMessage {
    pub(crate) fn check(self) -> Result<PageHello, MessageError> {
        if self.version != VERSION {
            return Err(MessageError::Version(self.version));
        }
        let role = self.role.map(|word| word.parse::<Role>());
        let seat = self.seat.map(|seat| {
            let token = secret(&seat.token).map(ResumeToken);
            token.map(|token| (ParticipantId(seat.participant), token))
        });
        Ok(PageHello {
            name: self.name,
            role: role
                .transpose()
                .map_err(|e| MessageError::Role(e.to_string()))?,
            grant: secret(&self.grant).map(Grant)?,
            tool: self.tool.map(ToolMessage::check).transpose()?,
            seat: seat.transpose()?,
        })
    }
}

fn secret(text: &str) -> Result<[u8; 16], MessageError> {
    let bytes = data_encoding::HEXLOWER_PERMISSIVE.decode(text.as_bytes());
    let bytes = bytes.map_err(|_| MessageError::Grant)?;
    bytes.try_into().map_err(|_| MessageError::Grant)
}

/// A tool in a message.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ToolMessage {
    kind: ToolWord,
    radius_mm: f64,
    length_mm: f64,
    width_mm: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum ToolWord {
    Ball,
    Blade,
    Needle,
    Plate,
    Forceps,
}

const MM: f64 = 1e-3;

impl ToolMessage {
    pub(crate) fn check(self) -> Result<ToolDescription, MessageError> {
        let tool = ToolDescription {
            kind: match self.kind {
                ToolWord::Ball => ToolKind::Probe,
                ToolWord::Blade => ToolKind::Scalpel,
                ToolWord::Needle => ToolKind::Needle,
                ToolWord::Plate => ToolKind::Plate,
                ToolWord::Forceps => ToolKind::Grasper,
            },
            radius_m: self.radius_mm * MM,
            length_m: self.length_mm * MM,
            width_m: self.width_mm * MM,
        };
        if tool.is_valid() {
            return Ok(tool);
        }
        let Self {
            radius_mm,
            length_mm,
            width_mm,
            ..
        } = self;
        Err(MessageError::Tool(format!(
            "radius {radius_mm}, length {length_mm}, width {width_mm} mm"
        )))
    }
}

impl From<ToolDescription> for ToolMessage {
    fn from(tool: ToolDescription) -> Self {
        Self {
            kind: match tool.kind {
                ToolKind::Probe => ToolWord::Ball,
                ToolKind::Scalpel => ToolWord::Blade,
                ToolKind::Needle => ToolWord::Needle,
                ToolKind::Plate => ToolWord::Plate,
                ToolKind::Grasper => ToolWord::Forceps,
            },
            radius_mm: tool.radius_m / MM,
            length_mm: tool.length_m / MM,
            width_mm: tool.width_m / MM,
        }
    }
}

/// A text message of the host.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum FromHost<'a> {
    Welcome(&'a Welcome),
    Refused {
        sentence: &'a str,
        is_temporary: bool,
    },
    State(&'a State),
    Notice {
        sentence: &'a str,
    },
    Goodbye {
        sentence: &'a str,
    },
    Invitation(&'a InvitationMessage),
    Pong {
        id: u32,
        sent_ms: f64,
        server_us: i64,
    },
}

impl FromHost<'_> {
    pub(crate) fn to_text(&self) -> String {
        // Numbers, texts and maps of texts always have a JSON form.
        serde_json::to_string(self).unwrap_or_default()
    }
}

/// The answer to the hello of an admitted page.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Welcome {
    /// The participant.
    pub participant: u16,
    /// Its name.
    pub name: String,
    /// Its role.
    pub role: &'static str,
    /// `server` or `replica`.
    pub source: &'static str,
    /// Whether motion of the page moves a tool.
    pub can_steer: bool,
    /// Views per second.
    pub tick_hz: u32,
    /// Regions of the model.
    pub regions: Vec<WelcomeRegion>,
    /// Takes the seat again after a lost connection.
    pub seat: Option<Seat>,
}

/// A region of the model.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WelcomeRegion {
    /// Its name in the scene.
    pub name: String,
    /// Name of its material.
    pub material: String,
    /// Whether it does not move.
    pub is_pinned: bool,
}

impl WelcomeRegion {
    /// The regions of a model.
    pub fn all(model: &palpate_tissue::Model) -> Vec<Self> {
        let region = |r: &palpate_tissue::Region| Self {
            name: r.name.clone(),
            material: r.material.name.clone(),
            is_pinned: r.pinned,
        };
        model.regions.iter().map(region).collect()
    }
}

/// The state of the session; unknown figures are `None`.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct State {
    /// The session.
    pub session: SessionState,
    /// All participants.
    pub participants: Vec<Participant>,
    /// Figures of the local client.
    pub own: Option<OwnFigures>,
    /// Annotations on the tissue.
    pub annotations: Vec<AnnotationMessage>,
    /// The view direction that the instructor showed last.
    pub camera: Option<CameraMessage>,
    /// Open invitations.
    pub invitations: Vec<OpenInvitation>,
}

/// An open invitation, without its secret.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OpenInvitation {
    /// Its number.
    pub id: u32,
    /// The role that it allows.
    pub role: &'static str,
    /// The only name that may use it.
    pub name: Option<String>,
    /// When it expires, µs of the server's clock.
    pub expires_us: i64,
    /// Whether the first join uses it up.
    pub is_single_use: bool,
}

/// The addresses of a new invitation, with its secret.
#[derive(Clone, PartialEq, Eq, Serialize)]
pub struct InvitationMessage {
    /// Its number.
    pub id: u32,
    /// The join link, for programs.
    pub link: String,
    /// The address of the page; `None` if the host does not know it or no browser can take the role.
    pub url: Option<String>,
}

impl fmt::Debug for InvitationMessage {
    /// Prints the number alone, because logs are shared.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "InvitationMessage({})", self.id)
    }
}

/// State of the session as a whole.
#[allow(
    clippy::struct_excessive_bools,
    reason = "independent flags of a message"
)]
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct SessionState {
    /// Age of the session, s.
    pub clock_s: f64,
    /// Playout delay, ms.
    pub delay_ms: f64,
    /// `none`, `fixed` or `adaptive`.
    pub delay_mode: &'static str,
    /// Cap of the delay, ms.
    pub delay_cap_ms: Option<f64>,
    /// Version of the topology.
    pub topology_version: u32,
    /// Hash of the topology, hexadecimal.
    pub topology_hash: String,
    /// Operations in the log.
    pub operations: Option<u64>,
    /// Cuts in effect.
    pub cuts: u64,
    /// Seats in all.
    pub seats: Option<u16>,
    /// Seats of spectators and recorders.
    pub spectators: Option<u16>,
    /// Whether the session is frozen.
    pub is_frozen: bool,
    /// Whether newcomers are refused.
    pub is_locked: bool,
    /// Whether there is a cut to undo.
    pub can_undo: bool,
    /// Whether there is a cut to redo.
    pub can_redo: bool,
    /// CPU use of the host by thread class, cores.
    pub cpu: BTreeMap<String, f64>,
}

/// One participant.
#[allow(
    clippy::struct_excessive_bools,
    reason = "independent flags of a message"
)]
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Participant {
    /// Its number.
    pub id: u16,
    /// Its name.
    pub name: String,
    /// Its role.
    pub role: &'static str,
    /// Its tool.
    pub tool: Option<ToolMessage>,
    /// Whether it is connected.
    pub is_connected: bool,
    /// Whether it is demoted because of its network.
    pub is_demoted: bool,
    /// Whether the instructor muted its tool.
    pub is_muted: bool,
    /// The instructor's limit of its force, N.
    pub force_limit_n: Option<f64>,
    /// The network that the instructor emulates for it; `None` for its real network alone.
    pub emulation: Option<EmulationMessage>,
    /// Round trip, ms.
    pub rtt_ms: Option<f64>,
    /// Share of lost packets.
    pub loss: Option<f64>,
    /// The delay that its network needs, ms.
    pub wanted_ms: Option<f64>,
    /// Whether it takes part in a browser.
    pub is_page: bool,
}

/// Figures of a local client.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct OwnFigures {
    /// Name of the device.
    pub device: String,
    /// Rate of the force loop.
    pub loop_hz: Option<f64>,
    /// Lateness of the force loop, 99th percentile, µs.
    pub late_us_p99: Option<f64>,
    /// Age of the contact model, ms.
    pub model_age_ms: Option<f64>,
    /// Magnitude of the rendered force, N.
    pub force_n: Option<f64>,
    /// CPU use by thread class, cores.
    pub cpu: BTreeMap<String, f64>,
    /// Round trip, ms.
    pub rtt_ms: Option<f64>,
    /// Share of lost packets.
    pub loss: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_pages_are_read_and_checked() {
        let grant = "0123456789abcdef0123456789abcdef";
        let hello = |text: &str| match FromPage::parse(text) {
            Ok(FromPage::Hello(hello)) => hello.check(),
            other => panic!("{other:?}"),
        };
        let tool = r#"{"kind":"blade","radius_mm":0.5,"length_mm":20,"width_mm":0}"#;
        let text = format!(
            r#"{{"type":"hello","version":1,"name":"ann","role":"trainee","grant":"{grant}","tool":{tool},"seat":null,"later":7}}"#
        );
        let read = hello(&text).unwrap();
        assert_eq!(
            (read.role, read.tool.unwrap().kind),
            (Some(Role::Trainee), ToolKind::Scalpel)
        );
        assert_eq!(read.grant.token(), grant);
        for (from, to, error) in [
            (grant, "12", MessageError::Grant.to_string()),
            (
                "\"version\":1",
                "\"version\":9",
                MessageError::Version(9).to_string(),
            ),
            ("trainee", "king", "unknown role".to_owned()),
            (
                "\"radius_mm\":0.5",
                "\"radius_mm\":-1",
                "radius -1".to_owned(),
            ),
        ] {
            let error_text = hello(&text.replace(from, to)).unwrap_err().to_string();
            assert!(error_text.contains(&error), "{error_text}");
        }
        for text in [
            "",
            "{}",
            "[]",
            r#"{"type":"fly"}"#,
            r#"{"type":"ping","id":-1,"sent_ms":0}"#,
        ] {
            assert!(
                matches!(FromPage::parse(text), Err(MessageError::Format(_))),
                "{text}"
            );
        }
        assert!(FromPage::parse(r#"{"type":"leave"}"#).is_ok());
    }

    #[test]
    fn tools_survive_both_ways() {
        for tool in [
            ToolDescription::probe(4e-3),
            ToolDescription::scalpel(5e-4, 0.02),
        ] {
            let back = ToolMessage::from(tool).check().unwrap();
            assert!((back.radius_m - tool.radius_m).abs() < 1e-12 && back.kind == tool.kind);
        }
    }
}
