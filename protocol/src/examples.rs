//! One message of every kind and more, with fixed numbers. The byte document, the tests on damaged bytes
//! and a fuzzer's corpus share this table.
//!
//! Datagrams encode differences from earlier ones. They are listed in the order of sending, and each
//! counts as acknowledged before the next is written: see [`datagram_bytes`].

use crate::codec::encode_frame;
use crate::control::{Anchor, Annotation, AnnotationKind, CameraView, Control};
use crate::datagram::{
    Acknowledgement, Body, Corrections, Datagram, Displacements, Expected, Header, Memory, Probe,
    Reply, Tag,
};
use crate::handshake::{
    Hello, ModelInfo, RefusalReason, Refused, Resume, Role, RosterEntry, SnapshotInfo,
    Subscription, Welcome,
};
use crate::lateness::Lateness;
use crate::operation::{
    BladePoint, CompensationMode, CompensationSettings, CutStroke, HeldTool, LeaveReason,
    Operation, OperationKind,
};
use crate::request::{
    ClientMessage, CutRequest, DelayReport, Invitation, Request, RequestKind, RequestRefusal,
    RequestRefused, ServerMessage, TimedBladePoint,
};
use crate::tool::{ToolDescription, ToolKind};
use crate::{
    ClientTime, Emulation, Epoch, Grant, ModelHash, OperationId, ParticipantId, Pose,
    ProtocolError, RequestId, ResumeToken, ServerTime, Span, ToolSample, ToolTrack, TopologyHash,
};

/// A message with a unique name.
#[derive(Debug, Clone, PartialEq)]
pub struct Example<M> {
    /// Its name.
    pub name: &'static str,
    /// The message.
    pub message: M,
}

const fn example<M>(name: &'static str, message: M) -> Example<M> {
    Example { name, message }
}

/// The connection of the examples.
pub const TAG: Tag = Tag {
    epoch: Epoch(3),
    stream: ParticipantId(2),
};

const NEIGHBOUR: ParticipantId = ParticipantId(3);

const BLADE: BladePoint = BladePoint {
    tip_m: [0.25, 0.5, -0.125],
    axis: [0.0, 0.0, 1.0],
    depth_m: 0.0625,
};

const SCALPEL: ToolDescription = ToolDescription::scalpel(0.0005, 0.02);

const PLATE: ToolDescription = ToolDescription {
    kind: ToolKind::Plate,
    radius_m: 0.002,
    length_m: 0.05,
    width_m: 0.03,
};

/// A view direction.
pub const CAMERA: CameraView = CameraView {
    position_m: [0.5, 0.0, 0.25],
    target_m: [0.0, 0.0, 0.25],
    up: [0.0, 0.0, 1.0],
};

/// An annotation.
pub fn annotation() -> Annotation {
    Annotation {
        id: 5,
        text: "cut here".to_owned(),
        kind: AnnotationKind::Arrow,
        anchor: Anchor {
            nodes: [40, 41, 300],
            weights: [0.5, 0.25, 0.25],
        },
        offset_m: [0.0, 0.0, 0.0625],
    }
}

/// Server time in milliseconds.
const fn ms(t: i64) -> ServerTime {
    ServerTime::from_micros(1000 * t)
}

/// Everything a client writes after its preamble.
pub fn client_messages() -> Vec<Example<ClientMessage>> {
    let hello = |resume| Hello {
        name: "Ann".to_owned(),
        role: Role::Trainee,
        grant: Grant([0x11; 16]),
        tool: Some(SCALPEL),
        resume,
        subscription: Subscription::Full,
    };
    let resume = Resume {
        participant: TAG.stream,
        token: ResumeToken([0x22; 16]),
        next_operation: OperationId(7),
        topology_version: 1,
        topology_hash: TopologyHash(0x0123_4567_89ab_cdef),
    };
    let request = |id, kind| {
        ClientMessage::Request(Request {
            id: RequestId(id),
            kind,
        })
    };
    let cut = CutRequest {
        began: ms(8950),
        points: [8990, 9000]
            .map(|t| TimedBladePoint {
                time: ms(t),
                blade: BLADE,
            })
            .to_vec(),
        width_m: 0.0005,
        is_last: false,
    };
    let topology = RequestKind::TopologyReport {
        version: 1,
        hash: TopologyHash(0x0123_4567_89ab_cdef),
    };
    let mut all = vec![
        example("Hello", ClientMessage::Hello(hello(None))),
        example("Hello again", ClientMessage::Hello(hello(Some(resume)))),
        example("Cut", request(1, RequestKind::Cut(cut))),
        example("Leave", request(2, RequestKind::Leave)),
        example("TopologyReport", request(3, topology)),
        example("SetTool", request(4, RequestKind::SetTool(PLATE))),
    ];
    for (control, id) in controls().into_iter().zip(5..) {
        let message = request(id, RequestKind::Control(control.message));
        all.push(example(control.name, message));
    }
    all
}

/// All controls, in the order of their variants.
fn controls() -> Vec<Example<Control>> {
    let participant = NEIGHBOUR;
    let mute = Control::Mute {
        participant,
        is_muted: true,
    };
    let force = Control::ForceLimit {
        participant,
        newtons: Some(2.5),
    };
    let capacity = Control::Capacity {
        seats: 8,
        spectators: 4,
    };
    let compensation = Control::Compensation {
        mode: CompensationMode::Adaptive { cap_us: 300_000 },
    };
    let invite = Control::Invite {
        role: Role::Trainee,
        name: Some("Cy".to_owned()),
        lifetime_s: 3600,
        is_single_use: true,
    };
    let emulate = Control::Emulate {
        participant,
        emulation: EMULATION,
    };
    vec![
        example("control Mute", mute),
        example("control HandOver", Control::HandOver { participant }),
        example("control Freeze", Control::Freeze { is_frozen: true }),
        example("control Reset", Control::Reset),
        example("control Undo", Control::Undo),
        example("control Redo", Control::Redo),
        example("control ForceLimit", force),
        example("control Kick", Control::Kick { participant }),
        example("control Ban", Control::Ban { participant }),
        example("control Lock", Control::Lock { is_locked: true }),
        example("control Capacity", capacity),
        example("control Compensation", compensation),
        example("control Annotate", Control::Annotate(annotation())),
        example(
            "control RemoveAnnotation",
            Control::RemoveAnnotation { id: 5 },
        ),
        example("control ShowCamera", Control::ShowCamera(CAMERA)),
        example("control Invite", invite),
        example(
            "control RevokeInvitation",
            Control::RevokeInvitation { id: 2 },
        ),
        example("control Emulate", emulate),
    ]
}

const EMULATION: Emulation = Emulation {
    delay_ms: 150,
    loss_permille: 50,
};

const DELAY: DelayReport = DelayReport {
    mean_us: 26_000,
    deviation_us: 900,
    wanted_us: 33_600,
};

fn welcome() -> Welcome {
    Welcome {
        participant: TAG.stream,
        epoch: TAG.epoch,
        role: Role::Trainee,
        server_time: ms(9000),
        model: ModelInfo {
            hash: ModelHash(0xfedc_ba98_7654_3210),
            bytes: 40_000_000,
        },
        roster: vec![RosterEntry {
            participant: NEIGHBOUR,
            name: "Bo".to_owned(),
            role: Role::Instructor,
            tool: Some(ToolDescription::probe(0.004)),
        }],
        topology_version: 1,
        topology_hash: TopologyHash(0x0123_4567_89ab_cdef),
        first_operation: OperationId(0),
        snapshot: None,
        operations_so_far: 7,
        compensation: CompensationSettings {
            mode: CompensationMode::Adaptive { cap_us: 200_000 },
            initial_delay_us: 50_000,
        },
        tick_hz: 250,
        session_started_at: None,
        resume_token: ResumeToken([0x22; 16]),
    }
}

fn operations() -> Vec<Example<OperationKind>> {
    let who = NEIGHBOUR;
    let stroke = CutStroke {
        began: ms(8950),
        joins: true,
        points: vec![BLADE],
        width_m: 0.0005,
    };
    let joined = OperationKind::Joined {
        participant: who,
        name: "Bo".to_owned(),
        role: Role::Instructor,
        tool: Some(ToolDescription::probe(0.004)),
    };
    let left = OperationKind::Left {
        participant: who,
        reason: LeaveReason::Silent,
    };
    let changed = OperationKind::ToolChanged {
        participant: who,
        tool: PLATE,
    };
    let demoted = OperationKind::Demoted {
        participant: who,
        wanted_us: 500_000,
        cap_us: 400_000,
    };
    let compensation = OperationKind::Compensation {
        delay_us: 60_000,
        effective_at: ms(9500),
    };
    vec![
        example("operation Cut", OperationKind::Cut(stroke)),
        example("operation Joined", joined),
        example("operation Left", left),
        example(
            "operation Disconnected",
            OperationKind::Disconnected { participant: who },
        ),
        example(
            "operation Reconnected",
            OperationKind::Reconnected { participant: who },
        ),
        example("operation ToolChanged", changed),
        example("operation Started", OperationKind::Started { at: ms(9000) }),
        example("operation Compensation", compensation),
        example("operation Demoted", demoted),
        example(
            "operation Restored",
            OperationKind::Restored { participant: who },
        ),
    ]
    .into_iter()
    .chain(control_operations())
    .collect()
}

/// The operations that follow from controls, in the order of their variants.
fn control_operations() -> Vec<Example<OperationKind>> {
    let participant = NEIGHBOUR;
    let muted = OperationKind::Muted {
        participant,
        is_muted: true,
    };
    let force = OperationKind::ForceLimit {
        participant,
        newtons: Some(2.5),
    };
    let access = OperationKind::Access {
        is_locked: true,
        seats: 8,
        spectators: 4,
    };
    let frozen = OperationKind::Frozen {
        is_frozen: true,
        held: vec![HeldTool {
            participant,
            pose: Pose {
                position_m: [0.25, 0.5, -0.125],
                ..Pose::IDENTITY
            },
            buttons: 1,
        }],
    };
    let mode = OperationKind::CompensationMode {
        mode: CompensationMode::Adaptive { cap_us: 300_000 },
    };
    let invited = OperationKind::Invited {
        id: 2,
        role: Role::Trainee,
        name: Some("Cy".to_owned()),
        expires_at: ms(3_609_000),
        is_single_use: true,
    };
    let emulated = OperationKind::Emulated {
        participant,
        emulation: EMULATION,
    };
    vec![
        example("operation Muted", muted),
        example("operation Frozen", frozen),
        example("operation Reset", OperationKind::Reset),
        example("operation Undone", OperationKind::Undone),
        example("operation Redone", OperationKind::Redone),
        example("operation ForceLimit", force),
        example("operation Access", access),
        example("operation CompensationMode", mode),
        example(
            "operation Annotated",
            OperationKind::Annotated(annotation()),
        ),
        example(
            "operation AnnotationRemoved",
            OperationKind::AnnotationRemoved { id: 5 },
        ),
        example("operation CameraShown", OperationKind::CameraShown(CAMERA)),
        example("operation Invited", invited),
        example(
            "operation InvitationUsed",
            OperationKind::InvitationUsed { id: 2 },
        ),
        example(
            "operation InvitationRevoked",
            OperationKind::InvitationRevoked { id: 3 },
        ),
        example("operation Emulated", emulated),
    ]
}

/// Everything a server writes after its preamble.
pub fn server_messages() -> Vec<Example<ServerMessage>> {
    let full = Refused::because(RefusalReason::Full {
        role: Role::Trainee,
        seats: 8,
    });
    let refused = |reason| {
        ServerMessage::RequestRefused(RequestRefused {
            id: RequestId(1),
            reason,
        })
    };
    let goodbye = ServerMessage::Goodbye {
        sentence: "the host went home".to_owned(),
    };
    let invitation = ServerMessage::Invitation(Invitation {
        id: 2,
        grant: Grant([0x33; 16]),
    });
    let late = Welcome {
        snapshot: Some(SnapshotInfo {
            bytes: 3,
            topology_version: 1,
        }),
        ..welcome()
    };
    let mut all = vec![
        example("Welcome", ServerMessage::Welcome(Box::new(welcome()))),
        example(
            "Welcome with snapshot",
            ServerMessage::Welcome(Box::new(late)),
        ),
        example("Snapshot", ServerMessage::Snapshot(vec![1, 2, 3])),
        example("Refused", ServerMessage::Refused(full)),
    ];
    for (i, operation) in operations().into_iter().enumerate() {
        let cuts = u32::from(operation.message.changes_topology());
        let message = ServerMessage::Operation(Operation {
            id: OperationId(7 + i as u64),
            at: ms(9000),
            author: NEIGHBOUR,
            topology_version_before: 1,
            topology_version_after: 1 + cuts,
            hash_after: TopologyHash(0x0123_4567_89ab_cdef),
            kind: operation.message,
        });
        all.push(example(operation.name, message));
    }
    let torn = RequestRefusal::CanNotCut("too deep".to_owned());
    all.extend([
        example("RequestRefused", refused(RequestRefusal::NothingCut)),
        example("RequestRefused with words", refused(torn)),
        example("Goodbye", goodbye),
        example("Invitation", invitation),
    ]);
    all
}

/// Five samples of a tool that goes along x and turns, the newest at `t_ms`.
fn track(participant: ParticipantId, t_ms: i64, buttons: u8, force: bool) -> ToolTrack {
    let sample = |i: i64| {
        let t = t_ms - 4 + i;
        let s = (t - 9000) as f64 * 1e-3;
        let turned = 0.25 + 0.5 * s;
        ToolSample {
            time: ms(t),
            pose: Pose {
                position_m: [0.1 + 0.08 * s, -0.02, 0.3 - s * s],
                orientation: [0.0, 0.0, turned, (1.0 - turned * turned).sqrt()],
            },
            buttons,
            force_n: (force && i == 4).then_some([0.5, 0.0, -1.25]),
        }
    };
    ToolTrack {
        participant,
        samples: (0..5).map(sample).collect(),
        late: Lateness::NONE,
    }
}

fn nodes(by: f32) -> Vec<(u32, [f32; 3])> {
    let node = |i: u32| (40 + 2 * i, [1e-4 * i as f32, 0.0, -by - 2e-4 * i as f32]);
    (0..6).map(node).collect()
}

/// Datagrams of one direction in the order in which they are sent: kinds of both directions, so that
/// one list has all.
pub fn datagrams() -> Vec<Example<Datagram>> {
    let corrections = |by| {
        Body::Corrections(Corrections {
            topology_version: 1,
            view_time: ms(9010),
            nodes: nodes(by),
        })
    };
    let displacements = Body::Displacements(Displacements {
        waiting: 12,
        step_um: 50,
        topology_version: 1,
        view_time: ms(9010),
        nodes: nodes(0.003),
    });
    let probe = Probe {
        id: 5,
        client_sent: ClientTime::from_micros(1_234_567),
    };
    let reply = Reply {
        id: 5,
        client_sent: probe.client_sent,
        server_received: ms(9018),
        server_sent: ms(9018),
    };
    let own = |t, buttons, force| track(TAG.stream, t, buttons, force);
    let neighbour = ToolTrack {
        late: Lateness {
            newest: Span::from_millis(3),
            oldest: Span::from_millis(40),
        },
        ..track(NEIGHBOUR, 9007, 0, true)
    };
    let both = vec![own(9008, 1, false), neighbour];
    let reports = vec![(TAG.stream, DELAY), (NEIGHBOUR, DelayReport::default())];
    let bodies = [
        ("motion, whole", Body::Motion(vec![own(9000, 0, false)])),
        ("motion", Body::Motion(vec![own(9004, 0, false)])),
        ("motion of two tools", Body::Motion(both)),
        ("corrections", corrections(0.003)),
        ("corrections that moved on", corrections(0.0031)),
        ("displacements", displacements),
        ("probe", Body::Probe(probe)),
        ("reply", Body::Reply(reply)),
        ("delays", Body::Delays(reports)),
        ("heartbeat", Body::Delays(Vec::new())),
        ("copy", Body::Copy((7, vec![0x01, 0x02, 0x03]))),
    ];
    let acknowledgement = Acknowledgement {
        newest: 77,
        bits: 0b1110_1111,
    };
    let datagram = |(i, (name, body)): (usize, (&'static str, Body))| {
        let generated = match &body {
            Body::Motion(tracks) => tracks[0].samples[4].time,
            _ => ms(9012 + i as i64),
        };
        let header = Header {
            tag: TAG,
            sequence: 501 + i as u32,
            generated,
            is_whole: i == 0,
            acknowledged: (i == 2).then_some(acknowledgement),
        };
        example(name, Datagram { header, body })
    };
    bodies.into_iter().enumerate().map(datagram).collect()
}

/// The receiver's state before each datagram of [`datagrams`].
pub fn expected() -> Expected {
    Expected {
        tag: TAG,
        sequence: 500,
        generated: ms(8996),
        sent: 80,
    }
}

/// The datagrams as bytes. A receiver reads them in this order with one [`Memory`].
pub fn datagram_bytes() -> Result<Vec<Example<Vec<u8>>>, ProtocolError> {
    let mut memory = Memory::default();
    let bytes = |d: Example<Datagram>| {
        let bytes = d.message.encode(&mut memory)?;
        memory.acknowledge(d.message.header.sequence);
        Ok(example(d.name, bytes))
    };
    datagrams().into_iter().map(bytes).collect()
}

/// The frames of [`client_messages`], then those of [`server_messages`].
pub fn frames() -> Result<[Vec<Example<Vec<u8>>>; 2], ProtocolError> {
    let client = client_messages().into_iter();
    let client = client.map(|m| Ok(example(m.name, encode_frame(&m.message)?)));
    let server = server_messages().into_iter();
    let server = server.map(|m| Ok(example(m.name, encode_frame(&m.message)?)));
    Ok([
        client.collect::<Result<_, ProtocolError>>()?,
        server.collect::<Result<_, ProtocolError>>()?,
    ])
}
