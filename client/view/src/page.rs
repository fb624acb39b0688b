//! The connection of one page.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use axum::extract::ws::Utf8Bytes;
use palpate_protocol::{ServerTime, Span, TokenBucket, ToolSample};
use tokio::sync::mpsc;

use crate::connection::{FrameFate, GOING_AWAY, Halves, Heard, Incoming, Outgoing, POLICY};
use crate::hub::HubEvent;
use crate::message::{FromHost, FromPage, PageHello, PageRequest};
use crate::motion;
use crate::round_trip::RoundTrip;

/// Text messages that may wait for a page; beyond them it is closed.
pub(crate) const TEXTS_MAX: usize = 256;

/// Frames that may wait for a page; further ones are dropped.
pub(crate) const FRAMES_MAX: usize = 4;

/// Messages of a page per second in the long run, and at once.
const MESSAGES_PER_S: f64 = 400.0;
const MESSAGES_BURST: f64 = 800.0;

/// A page without a hello is closed after this time.
const HELLO_MAX: Duration = Duration::from_secs(5);

/// Time between two measurements of the round trip.
const PROBE_PERIOD: Duration = Duration::from_secs(1);

/// A silent page is closed after this time; pages send something twice a second.
const SILENCE_MAX: Duration = Duration::from_secs(5);

/// Answers that may wait for a page.
const REPLIES_MAX: usize = 32;

/// Number of a page.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PageId(pub u64);

/// An event of a page, for the program that owns the session.
#[derive(Debug, Clone, PartialEq)]
pub struct PageInput {
    /// The page.
    pub page: PageId,
    /// When it arrived.
    pub at: ServerTime,
    /// The event.
    pub event: PageEvent,
}

/// The events of a page: a hello, then any others, then a close.
#[derive(Debug, Clone, PartialEq)]
pub enum PageEvent {
    /// The page asks to take part.
    Hello(Box<PageHello>),
    /// Motion of its tool.
    Motion {
        /// The samples, oldest first.
        samples: Vec<ToolSample>,
        /// The longest round trip of the last half minute; `None` before the first one.
        round_trip: Option<Span>,
    },
    /// A request.
    Request(PageRequest),
    /// The page is gone. It is the last event.
    Closed {
        /// The reason, if the host closed it for a violation of the format.
        violation: Option<String>,
    },
}

/// A message that waits for a page, reliably and in order.
#[derive(Debug, Clone)]
pub(crate) enum Reliable {
    Text(Utf8Bytes),
    /// The text that lets the page take part.
    Welcome(Utf8Bytes),
    Bytes(Bytes),
    Close(String),
}

/// Reads the clock of the server.
pub(crate) type Clock = Arc<dyn Fn() -> ServerTime + Send + Sync>;

/// One page with its queues.
pub(crate) struct Page {
    pub(crate) id: PageId,
    pub(crate) reliable: mpsc::Receiver<Reliable>,
    pub(crate) frames: mpsc::Receiver<Bytes>,
    pub(crate) hub: mpsc::Sender<HubEvent>,
    pub(crate) inputs: mpsc::Sender<PageInput>,
    pub(crate) clock: Clock,
}

/// Why a page was closed.
enum End {
    Gone,
    /// The host ends it.
    Closed(String),
    Violation(String),
}

impl Page {
    /// Serves a page until it is gone.
    pub(crate) async fn serve(self, (outgoing, mut incoming): Halves) {
        let (replies, waiting) = mpsc::channel(REPLIES_MAX);
        let Self {
            id,
            reliable,
            frames,
            hub,
            inputs,
            clock,
        } = self;
        let opened = Instant::now();
        let mut writer = Writer {
            id,
            outgoing,
            reliable,
            frames,
            replies: waiting,
            hub,
            opened,
        };
        let mut reader = Reader {
            id,
            inputs,
            clock,
            hub: writer.hub.clone(),
            replies,
            opened,
            round_trip: RoundTrip::default(),
            has_greeted: false,
        };
        // A page is read while a large surface is being sent to it.
        let end = tokio::select! {
            end = reader.run(&mut incoming) => end,
            end = writer.run() => end,
        };
        let violation = match end {
            End::Gone => None,
            End::Closed(sentence) => {
                writer.outgoing.close(incoming, GOING_AWAY, &sentence).await;
                None
            }
            End::Violation(sentence) => {
                tracing::info!(page = id.0, %sentence, "page closed");
                writer.outgoing.close(incoming, POLICY, &sentence).await;
                Some(sentence)
            }
        };
        let _ = writer.hub.send(HubEvent::Closed(id)).await;
        reader.input(PageEvent::Closed { violation }).await;
    }
}

/// The half of a page's task that sends.
struct Writer {
    id: PageId,
    outgoing: Outgoing,
    reliable: mpsc::Receiver<Reliable>,
    frames: mpsc::Receiver<Bytes>,
    replies: mpsc::Receiver<Reply>,
    hub: mpsc::Sender<HubEvent>,
    opened: Instant,
}

/// News of the reader.
enum Reply {
    /// The page has said hello.
    Hello,
    /// The answer to a ping.
    Pong(String),
}

impl Writer {
    async fn run(&mut self) -> End {
        let mut probes = tokio::time::interval(PROBE_PERIOD);
        loop {
            let is_there = tokio::select! {
                biased;
                Some(reply) = self.replies.recv() => match reply {
                    Reply::Hello => {
                        self.outgoing.handle_hello();
                        true
                    }
                    Reply::Pong(text) => self.outgoing.send(Reliable::Text(text.into())).await,
                },
                _ = probes.tick() => {
                    self.outgoing.ping(self.opened.elapsed().as_micros() as u64).await
                }
                reliable = self.reliable.recv() => match reliable {
                    Some(Reliable::Close(sentence)) => return End::Closed(sentence),
                    Some(message) => self.outgoing.send(message).await,
                    // The hub has dropped the page.
                    None => return End::Closed("the page is too slow".to_owned()),
                },
                Some(frame) = self.frames.recv() => {
                    let fate = self.outgoing.send_frame(frame).await;
                    if fate == FrameFate::Dropped {
                        let _ = self.hub.send(HubEvent::Missed(self.id)).await;
                    }
                    fate != FrameFate::Gone
                }
            };
            if !is_there {
                return End::Gone;
            }
        }
    }
}

/// The half of a page's task that receives.
struct Reader {
    id: PageId,
    inputs: mpsc::Sender<PageInput>,
    clock: Clock,
    hub: mpsc::Sender<HubEvent>,
    replies: mpsc::Sender<Reply>,
    opened: Instant,
    round_trip: RoundTrip,
    has_greeted: bool,
}

impl Reader {
    async fn run(&mut self, incoming: &mut Incoming) -> End {
        let mut bucket = TokenBucket::new(MESSAGES_PER_S, MESSAGES_BURST, Span::ZERO);
        loop {
            let patience = if self.has_greeted {
                SILENCE_MAX
            } else {
                HELLO_MAX.saturating_sub(self.opened.elapsed())
            };
            let message = match tokio::time::timeout(patience, incoming.receive()).await {
                Ok(message) => message,
                Err(_) if !self.has_greeted => {
                    return End::Violation(format!("no hello within {} s", HELLO_MAX.as_secs()));
                }
                Err(_) => return End::Gone,
            };
            let age = Span::from_micros(self.opened.elapsed().as_micros() as i64);
            if let Heard::Answer(stamp) = &message {
                self.round_trip.note_answer(stamp, age);
            } else if let Some(trip) = incoming.round_trip() {
                self.round_trip.note(trip, age);
            }
            if !bucket.take(1.0, age) {
                return End::Violation(format!("more than {MESSAGES_PER_S} messages per second"));
            }
            match self.take(message) {
                // A page that does not read its answers is not read.
                Ok(Some(Answer::Text(text))) => {
                    let _ = self.replies.send(Reply::Pong(text)).await;
                }
                Ok(Some(Answer::Event(event))) => {
                    if matches!(event, PageEvent::Hello(_)) {
                        let _ = self.replies.send(Reply::Hello).await;
                    }
                    self.input(event).await;
                }
                Ok(Some(Answer::Springs(region))) => {
                    let _ = self.hub.send(HubEvent::Springs(self.id, region)).await;
                }
                Ok(None) => {}
                Err(end) => return end,
            }
        }
    }

    /// Reads a message.
    fn take(&mut self, message: Heard) -> Result<Option<Answer>, End> {
        let violation = |sentence: String| Err(End::Violation(sentence));
        let event = match message {
            Heard::Text(text) => match FromPage::parse(&text) {
                Ok(FromPage::Ping { id, sent_ms }) => {
                    let server_us = (self.clock)().as_micros();
                    let pong = FromHost::Pong {
                        id,
                        sent_ms,
                        server_us,
                    };
                    return Ok(Some(Answer::Text(pong.to_text())));
                }
                Ok(FromPage::Hello(hello)) if !self.has_greeted => {
                    self.has_greeted = true;
                    match hello.check() {
                        Ok(hello) => PageEvent::Hello(Box::new(hello)),
                        Err(error) => return violation(error.to_string()),
                    }
                }
                Ok(FromPage::Hello(_)) => return violation("a second hello".to_owned()),
                Ok(FromPage::Tool { tool }) => match tool.check() {
                    Ok(tool) => PageEvent::Request(PageRequest::Tool(tool)),
                    Err(error) => return violation(error.to_string()),
                },
                Ok(FromPage::Control(control)) => match control.check() {
                    Ok(control) => PageEvent::Request(PageRequest::Control(control)),
                    Err(error) => return violation(error.to_string()),
                },
                Ok(FromPage::Springs { region }) if self.has_greeted => {
                    return Ok(Some(Answer::Springs(region)));
                }
                Ok(FromPage::Springs { .. }) => {
                    return violation("the first message is not a hello".to_owned());
                }
                Ok(FromPage::Leave) => PageEvent::Request(PageRequest::Leave),
                Err(error) => return violation(error.to_string()),
            },
            Heard::Binary(bytes) => match motion::parse(&bytes) {
                Some(samples) => PageEvent::Motion {
                    samples,
                    round_trip: self.round_trip.longest(),
                },
                None => {
                    return violation(
                        "a motion message that is not in the page's format".to_owned(),
                    );
                }
            },
            Heard::Violation(sentence) => return violation(sentence),
            Heard::Answer(_) | Heard::Other => return Ok(None),
            Heard::Gone => return Err(End::Gone),
        };
        if !self.has_greeted {
            return violation("the first message is not a hello".to_owned());
        }
        Ok(Some(Answer::Event(event)))
    }

    async fn input(&self, event: PageEvent) {
        let input = PageInput {
            page: self.id,
            at: (self.clock)(),
            event,
        };
        // A program that is busy delays this page only.
        let _ = self.inputs.send(input).await;
    }
}

enum Answer {
    Text(String),
    Event(PageEvent),
    /// The springs that the page shows from now on, for the hub.
    Springs(Option<u16>),
}
