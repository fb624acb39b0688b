//! The page of this client: its own replica in a browser on the same machine.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use palpate_device::backend::pointer::{PointerEvent, PointerHandle};
use palpate_device::{Buttons, Pose as DevicePose};
use palpate_protocol::handshake::Welcome;
use palpate_protocol::operation::Operation;
use palpate_protocol::request::{Invitation, RequestKind};
use palpate_protocol::session::ClientEvent;
use palpate_protocol::{
    ClientTime, Grant, JoinLink, ParticipantId, Pose, ServerTime, Span, ToolSample,
};
use palpate_site::{ToolAt, ViewFrame};
use palpate_tissue::{Model, Shape, Topology};
use palpate_transport::ClientCommand;
use palpate_transport::threads::background_runtime;
use palpate_view::{
    Board, Feed, InvitationMessage, PageEvent, PageId, PageInput, PageRequest, ShownTool, State,
    ToolFrame, ToolPose, ViewConfig, ViewListener, ViewServer, WelcomeRegion,
};
use tokio::runtime::Runtime;
use tokio::sync::{mpsc, watch};

use crate::ClientError;
use crate::realtime::{Frame, device_time, monotonic_now};

/// The server's clock as this client knows it.
#[derive(Debug, Default)]
struct SharedClock {
    /// Server time minus client time, µs.
    offset_us: AtomicI64,
}

impl SharedClock {
    fn now(&self) -> ServerTime {
        let us = monotonic_now().as_micros() + self.offset_us.load(Ordering::Relaxed);
        ServerTime::from_micros(us)
    }
}

/// Time that windows have to receive the last sentence.
const CLOSING: Duration = Duration::from_millis(100);

/// Time between two states.
const STATE_PERIOD: Span = Span::from_millis(200);

/// The log of the session, on its way to the main thread.
enum BoardUpdate {
    Welcome(Box<Welcome>),
    /// Strokes in effect and strokes taken back.
    Strokes([Vec<u64>; 2]),
    Operation(Box<Operation>),
    Invitation(Invitation),
}

/// The page of a session. Dropping it closes all its windows.
pub(crate) struct LocalPage {
    view: ViewServer,
    url: String,
    /// The link by which this client joined.
    link: JoinLink,
    board: Board,
    updates: Receiver<BoardUpdate>,
    clock: Arc<SharedClock>,
    window: Option<PageWindow>,
    due: ClientTime,
    _runtime: Runtime,
}

/// The replica's end of the page.
pub(crate) struct PageWindow {
    view: ViewServer,
    feed: Feed,
    clock: Arc<SharedClock>,
    updates: Sender<BoardUpdate>,
    me: watch::Sender<ParticipantId>,
}

impl LocalPage {
    /// Serves the page at a bound address. `pointer` makes it the device.
    pub(crate) fn start(
        listener: ViewListener,
        link: JoinLink,
        welcome: &Welcome,
        model: &Model,
        commands: mpsc::Sender<ClientCommand>,
        pointer: Option<PointerHandle>,
    ) -> Result<Self, ClientError> {
        let runtime = background_runtime().map_err(ClientError::System)?;
        let clock = Arc::<SharedClock>::default();
        let reading = Arc::clone(&clock);
        let config = ViewConfig::local(listener, move || reading.now());
        let (view, feed, inputs) = ViewServer::start(config, runtime.handle())?;
        // Other users of this machine could open the port.
        let grant = Grant(rand::random());
        let fragment = format!("grant={}", grant.token());
        let url = view.address().url("localhost", &fragment);
        let (me, mine) = watch::channel(welcome.participant);
        let visitors = Visitors {
            admitted: BTreeSet::new(),
            me: mine,
            view: view.clone(),
            grant,
            welcome: local_welcome(welcome, model, pointer.is_some()),
            commands,
            clock: Arc::clone(&clock),
            pointer,
        };
        runtime.spawn(visitors.serve(inputs));
        let (sender, updates) = channel();
        let window = PageWindow {
            view: view.clone(),
            feed,
            clock: Arc::clone(&clock),
            updates: sender,
            me,
        };
        Ok(Self {
            view,
            url,
            link,
            board: Board::of(welcome),
            updates,
            clock,
            window: Some(window),
            due: monotonic_now(),
            _runtime: runtime,
        })
    }

    /// Its address, with the secret that opens it.
    pub(crate) fn url(&self) -> &str {
        &self.url
    }

    /// The replica's end, once.
    pub(crate) fn take_window(&mut self) -> Option<PageWindow> {
        self.window.take()
    }

    /// Follows the log. Returns the state if it is due, to be measured and [shown](Self::show).
    pub(crate) fn poll(&mut self, now: ClientTime) -> Option<State> {
        while let Ok(update) = self.updates.try_recv() {
            match update {
                // A log that continues says nothing of the state before.
                BoardUpdate::Welcome(welcome) if welcome.first_operation.0 == 0 => {
                    self.board = Board::of(&welcome);
                }
                BoardUpdate::Welcome(_) => {}
                BoardUpdate::Strokes(strokes) => self.board.set_strokes(strokes),
                BoardUpdate::Operation(operation) => self.board.apply(&operation),
                BoardUpdate::Invitation(invitation) => self.show_invitation(invitation),
            }
        }
        if now < self.due {
            return None;
        }
        self.due = now + STATE_PERIOD;
        let mut state = self.board.state();
        state.session.clock_s = self.clock.now().as_micros() as f64 * 1e-6;
        Some(state)
    }

    /// Shows the link of an invitation in all windows, which belong to one participant. The server's page is unknown
    /// here.
    fn show_invitation(&self, Invitation { id, grant }: Invitation) {
        let state = self.board.state();
        let open = state.invitations.iter().find(|open| open.id == id);
        let Some(role) = open.and_then(|open| open.role.parse().ok()) else {
            return;
        };
        let link = JoinLink {
            role,
            grant,
            ..self.link.clone()
        };
        let message = InvitationMessage {
            id,
            link: link.to_string(),
            url: None,
        };
        self.view.show_invitation(None, &message);
    }

    /// Shows the state of the session.
    pub(crate) fn show(&self, state: &State) {
        self.view.show_state(state);
    }

    /// Ends all windows with a sentence.
    pub(crate) fn close(self, sentence: &str) {
        self.view.close(sentence);
        // The windows' tasks send the sentence.
        std::thread::sleep(CLOSING);
    }

    /// Shows a sentence.
    pub(crate) fn notice(&self, sentence: &str) {
        self.view.notice(None, sentence);
    }
}

impl PageWindow {
    /// An end for the thread that solves the view.
    pub(crate) fn feed(&self) -> Feed {
        self.feed.clone()
    }

    /// Follows the log and the estimate of the server's clock.
    pub(crate) fn note(&self, event: &ClientEvent, now: ClientTime) {
        let update = match event {
            ClientEvent::Welcomed(welcome) => {
                self.me.send_replace(welcome.participant);
                BoardUpdate::Welcome(welcome.clone())
            }
            ClientEvent::Operation(operation) => {
                BoardUpdate::Operation(Box::new(operation.clone()))
            }
            ClientEvent::Invitation(invitation) => BoardUpdate::Invitation(*invitation),
            ClientEvent::Clock(map) => {
                let offset_us = map.to_server(now).as_micros() - now.as_micros();
                return self.clock.offset_us.store(offset_us, Ordering::Relaxed);
            }
            _ => return,
        };
        // The main thread ends last.
        let _ = self.updates.send(update);
    }

    /// Takes over the strokes of a snapshot: those in effect and those taken back.
    pub(crate) fn note_strokes(&self, strokes: [Vec<u64>; 2]) {
        let _ = self.updates.send(BoardUpdate::Strokes(strokes));
    }

    /// Shows a view that this machine did not solve.
    pub(crate) fn show_thin(&mut self, topology: &Arc<Topology>, shape: &Shape, frame: &ViewFrame) {
        let at = (frame.s, frame.returns());
        self.feed.show(topology, shape, at, &[]);
        self.show_tools(frame, None);
    }

    /// Shows the tools of a view, and the own device at present.
    pub(crate) fn show_tools(&self, frame: &ViewFrame, device: Option<&Frame>) {
        let shared = |tool: &ToolAt| ToolPose {
            participant: tool.participant,
            is_active: tool.strength > 0.0,
            buttons: tool.buttons,
            pose: wire_pose(tool),
            returns: tool.returns,
            ..ToolPose::default()
        };
        let mut tools: Vec<ToolPose> = frame.tools.iter().map(shared).collect();
        if let Some(device) = device {
            tools.extend(own_tools(*self.me.borrow(), device));
        }
        self.view.show_tools(ToolFrame {
            delay: frame.delay,
            time: frame.s,
            sent: self.clock.now(),
            tools,
        });
    }
}

/// The own device at present, and the proxy while the tissue presses it.
fn own_tools(participant: ParticipantId, frame: &Frame) -> impl Iterator<Item = ToolPose> {
    let DevicePose {
        position,
        orientation,
    } = frame.sample.pose;
    let device = ToolPose {
        participant,
        shown: ShownTool::OwnDevice,
        is_active: true,
        buttons: frame.tool_buttons(),
        pose: Pose {
            position_m: position.into(),
            orientation: orientation.coords.into(),
        },
        force_n: frame.felt.force.into(),
        returns: false,
    };
    let mut proxy = ToolPose {
        shown: ShownTool::OwnProxy,
        ..device
    };
    proxy.pose.position_m = (position + frame.proxy_offset).into();
    let is_pressed = frame.proxy_offset.norm() > 0.0;
    [Some(device), is_pressed.then_some(proxy)]
        .into_iter()
        .flatten()
}

fn wire_pose(tool: &ToolAt) -> Pose {
    Pose {
        position_m: tool.position.into(),
        orientation: tool.orientation.coords.into(),
    }
}

fn local_welcome(welcome: &Welcome, model: &Model, can_steer: bool) -> palpate_view::Welcome {
    let me = welcome.participant;
    let own = welcome.roster.iter().find(|e| e.participant == me);
    palpate_view::Welcome {
        participant: me.0,
        name: own.map_or_else(String::new, |entry| entry.name.clone()),
        role: welcome.role.word(),
        source: "replica",
        can_steer,
        tick_hz: welcome.tick_hz,
        regions: WelcomeRegion::all(model),
        seat: None,
    }
}

/// The task that answers the windows of the page.
struct Visitors {
    view: ViewServer,
    /// Windows that showed the grant; events of others are ignored.
    admitted: BTreeSet<PageId>,
    /// This participant, whose number changes when the client joins again.
    me: watch::Receiver<ParticipantId>,
    grant: Grant,
    welcome: palpate_view::Welcome,
    commands: mpsc::Sender<ClientCommand>,
    clock: Arc<SharedClock>,
    pointer: Option<PointerHandle>,
}

impl Visitors {
    async fn serve(mut self, mut inputs: mpsc::Receiver<PageInput>) {
        loop {
            let input = tokio::select! {
                input = inputs.recv() => input,
                Ok(()) = self.me.changed() => {
                    self.welcome.participant = self.me.borrow_and_update().0;
                    for page in &self.admitted {
                        self.view.welcome(*page, &self.welcome);
                    }
                    continue;
                }
            };
            let Some(PageInput { page, event, .. }) = input else {
                return;
            };
            match event {
                PageEvent::Hello(hello) if hello.grant.matches(&self.grant) => {
                    self.admitted.insert(page);
                    self.view.welcome(page, &self.welcome);
                }
                PageEvent::Hello(_) => {
                    let sentence = "the address of the page is not that of this client; open the whole address that it printed";
                    self.view.refuse(page, sentence, false);
                }
                _ if !self.admitted.contains(&page) => {}
                PageEvent::Motion { samples, .. } => {
                    for sample in &samples {
                        self.steer(sample);
                    }
                }
                PageEvent::Request(request) => self.request(page, request),
                PageEvent::Closed { .. } => {
                    self.admitted.remove(&page);
                    self.release();
                }
            }
        }
    }

    fn request(&self, page: PageId, request: PageRequest) {
        let request = match request {
            PageRequest::Tool(tool) => RequestKind::SetTool(tool),
            PageRequest::Control(control) => RequestKind::Control(control),
            // The program itself ends the session.
            PageRequest::Leave => return,
        };
        if self
            .commands
            .try_send(ClientCommand::Request(request))
            .is_err()
        {
            self.view.notice(
                Some(page),
                "your request could not be sent; please repeat it",
            );
        }
    }

    /// Moves the device to a sample's pose. A device that is behind misses the sample.
    fn steer(&mut self, sample: &ToolSample) {
        let Some(pointer) = &mut self.pointer else {
            return;
        };
        let age = self.clock.now() - sample.time;
        let [x, y, z, w] = sample.pose.orientation;
        let turn = nalgebra::Quaternion::new(w, x, y, z);
        let event = PointerEvent {
            time: device_time(monotonic_now() - age),
            goal: Some(DevicePose {
                position: sample.pose.position_m.into(),
                orientation: nalgebra::UnitQuaternion::from_quaternion(turn),
            }),
            buttons: Buttons::from_bits(u32::from(sample.buttons)),
        };
        let _ = pointer.send(event);
    }

    /// A page that is gone holds no button.
    fn release(&mut self) {
        if let Some(pointer) = &mut self.pointer {
            let event = PointerEvent {
                time: device_time(monotonic_now()),
                goal: None,
                buttons: Buttons::NONE,
            };
            let _ = pointer.send(event);
        }
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::control::Control;
    use palpate_view::PageHello;

    use super::*;

    /// Requests that reach the session after a hello with this grant.
    fn requests_after(grant: Grant) -> usize {
        let runtime = background_runtime().unwrap();
        let listener = ViewListener::bind("127.0.0.1:0".parse().unwrap()).unwrap();
        let config = ViewConfig::local(listener, || ServerTime::ZERO);
        let (view, _feed, _inputs) = ViewServer::start(config, runtime.handle()).unwrap();
        let (commands, mut sent) = mpsc::channel(8);
        let (_me, mine) = watch::channel(ParticipantId(1));
        let visitors = Visitors {
            view,
            admitted: BTreeSet::new(),
            me: mine,
            grant: Grant([7; 16]),
            welcome: palpate_view::Welcome {
                participant: 1,
                name: "ann".to_owned(),
                role: "instructor",
                source: "replica",
                can_steer: false,
                tick_hz: 30,
                regions: Vec::new(),
                seat: None,
            },
            commands,
            clock: Arc::default(),
            pointer: None,
        };
        let hello = PageHello {
            name: String::new(),
            role: None,
            grant,
            tool: None,
            seat: None,
        };
        let (inputs, received) = mpsc::channel(8);
        for event in [
            PageEvent::Hello(Box::new(hello)),
            PageEvent::Request(PageRequest::Control(Control::Reset)),
        ] {
            let input = PageInput {
                page: PageId(1),
                at: ServerTime::ZERO,
                event,
            };
            inputs.try_send(input).unwrap();
        }
        drop(inputs);
        runtime.block_on(visitors.serve(received));
        std::iter::from_fn(|| sent.try_recv().ok()).count()
    }

    #[test]
    fn page_with_a_wrong_grant_requests_nothing() {
        assert_eq!(requests_after(Grant([7; 16])), 1);
        assert_eq!(requests_after(Grant([0; 16])), 0);
    }
}
