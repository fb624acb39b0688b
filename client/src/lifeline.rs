//! The connection of a session that stands: pumped while it lives, made anew when it is lost.

use std::time::Duration;

use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::{Hello, Resume, Welcome};
use palpate_protocol::operation::{Operation, OperationKind};
use palpate_protocol::session::{ClientEvent, CloseReason};
use palpate_protocol::{JoinLink, OperationId, TopologyHash};
use palpate_transport::{ClientCommand, ClientHandle, DriverStats, TransportError};
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

use crate::ClientError;
use crate::inbox::Inbox;
use crate::network::join;
use crate::requests::{Requests, is_felt};

/// A session that says its link is lost is given up so much later: the server then has given up the
/// connection too, and waits for a new one.
const SILENCE_MAX: Duration = Duration::from_secs(1);

/// Before the first attempt to come back; doubled for every further one.
const WAIT_FIRST: Duration = Duration::from_millis(250);

/// The longest wait between two attempts.
const WAIT_MAX: Duration = Duration::from_secs(8);

/// One attempt at most. Packets of a handshake are repeated after 0.3, 0.6, 1.2 s: beyond that a new
/// handshake is sooner heard than an old one.
const ATTEMPT_MAX: Duration = Duration::from_secs(4);

/// What was asked for so long ago is not asked again: the hand has gone on, and the tissue may lie
/// elsewhere.
const REPEAT_WITHIN: Duration = Duration::from_secs(10);

/// How the connection does, for the status line.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Condition {
    /// Why it is lost, while it is.
    pub(crate) lost: Option<String>,
    /// How often it was made anew.
    pub(crate) returns: u64,
    /// Requests that were not sent, because there was no connection, or that were not answered in time.
    pub(crate) requests_lost: u64,
}

/// What a connection needs to be made anew, and the ends that outlive it.
pub(crate) struct Lifeline<'a> {
    pub(crate) link: &'a JoinLink,
    pub(crate) hello: Hello,
    pub(crate) seat: Resume,
    /// How long to try.
    pub(crate) patience: Duration,
    pub(crate) inbox: &'a Inbox,
    pub(crate) commands: mpsc::Receiver<ClientCommand>,
    /// Says why the log is wanted from its beginning.
    pub(crate) rejoin: mpsc::Receiver<String>,
    pub(crate) requests: Requests,
    /// The artificial delay as the log says it.
    pub(crate) delay: DelaySchedule,
    pub(crate) stats: watch::Sender<DriverStats>,
    pub(crate) condition: watch::Sender<Condition>,
    pub(crate) is_lost: bool,
}

/// Whether the seat of a session that is over can be taken again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Farewell {
    /// The server has given up the seat.
    Final,
    /// The server may keep the seat: it was not reached again.
    Open,
}

/// Why a connection is pumped no more.
enum Over {
    /// The session is over, and the inbox knows.
    Ended,
    /// The participant goes.
    Leaving,
    /// Only the connection is lost.
    Lost(String),
    /// The copy of the tissue is to be made anew.
    Anew(String),
}

impl Lifeline<'_> {
    /// Keeps the session standing until it is over.
    pub(crate) async fn run(mut self, mut handle: ClientHandle) -> Farewell {
        loop {
            let (why, is_lost) = match self.pump(&mut handle).await {
                Over::Ended | Over::Leaving => {
                    end(handle).await;
                    return Farewell::Final;
                }
                Over::Lost(why) => (why, true),
                Over::Anew(why) => (why, false),
            };
            // Leaving politely would give up the seat.
            handle.task.abort();
            match self.come_back(why, is_lost).await {
                Some(again) => handle = again,
                None => return Farewell::Open,
            }
        }
    }

    /// Reasons for a copy made anew that still wait, when it is about to be: a second one helps nobody.
    fn forget_wishes(&mut self) {
        while self.rejoin.try_recv().is_ok() {}
    }

    async fn pump(&mut self, handle: &mut ClientHandle) -> Over {
        let mut give_up: Option<Instant> = None;
        loop {
            let silence = async {
                match give_up {
                    Some(at) => tokio::time::sleep_until(at).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                event = handle.events.recv() => {
                    match &event {
                        Some(ClientEvent::LinkLost) => give_up = Some(Instant::now() + SILENCE_MAX),
                        Some(ClientEvent::LinkRestored) => give_up = None,
                        _ => {}
                    }
                    if let Some(over) = self.take(event) {
                        return over;
                    }
                }
                command = self.commands.recv() => match command {
                    Some(command) => self.pass_on(handle, command),
                    None => return Over::Leaving,
                },
                Some(why) = self.rejoin.recv() => {
                    self.want_everything();
                    return Over::Anew(why);
                }
                Ok(()) = handle.stats.changed() => {
                    self.stats.send_replace(*handle.stats.borrow_and_update());
                }
                () = silence => {
                    return Over::Lost("nothing was heard from the server for 2 s".to_owned());
                }
            }
        }
    }

    /// Notes an event and puts it into the inbox.
    fn take(&mut self, event: Option<ClientEvent>) -> Option<Over> {
        let lost = |reason: &CloseReason| {
            matches!(
                reason,
                CloseReason::ConnectionLost(_) | CloseReason::Silent(_)
            )
        };
        let event = match event {
            None => return Some(Over::Lost("the session ended without a word".to_owned())),
            Some(ClientEvent::Closed(reason)) if lost(&reason) => {
                return Some(Over::Lost(reason.to_string()));
            }
            Some(event) => event,
        };
        match &event {
            ClientEvent::LinkLost => self.is_lost = true,
            ClientEvent::LinkRestored => self.is_lost = false,
            ClientEvent::Operation(operation) => self.note(operation),
            _ => {}
        }
        let is_nobodys =
            matches!(&event, ClientEvent::RequestRefused(r) if !self.requests.is_felt(r));
        self.requests.handle_event(&event);
        if is_nobodys {
            return None;
        }
        let is_last = matches!(event, ClientEvent::Closed(_));
        if !self.inbox.push(event) {
            self.close("the operations came faster than this machine applies them".to_owned());
            return Some(Over::Ended);
        }
        is_last.then_some(Over::Ended)
    }

    /// Notes what the next connection goes on with.
    fn note(&mut self, operation: &Operation) {
        self.seat.note(operation);
        if let OperationKind::ToolChanged { participant, tool } = operation.kind
            && participant == self.seat.participant
        {
            self.hello.tool = Some(tool);
        }
        if let OperationKind::Compensation {
            delay_us,
            effective_at,
        } = operation.kind
        {
            self.delay.handle_change(delay_us, effective_at);
        }
    }

    fn pass_on(&mut self, handle: &ClientHandle, command: ClientCommand) {
        match (command, handle.commands.try_reserve()) {
            (ClientCommand::Request(kind), Ok(room)) => {
                room.send(ClientCommand::Numbered(self.requests.number(kind)));
            }
            (ClientCommand::Request(kind), Err(mpsc::error::TrySendError::Closed(()))) => {
                // Nothing goes over this connection any more; it is asked again with the next one.
                self.requests.number(kind);
            }
            (ClientCommand::Request(kind), Err(mpsc::error::TrySendError::Full(()))) => {
                // A number that is jumped over would count as done, when a later one has come.
                if is_felt(&kind) {
                    tracing::warn!("the session does not take requests");
                    self.condition.send_modify(|c| c.requests_lost += 1);
                }
            }
            (command, Ok(room)) => room.send(command),
            // Motion is worth nothing later.
            (_, Err(_)) => {}
        }
    }

    /// Takes the seat with nothing in hand, so that the whole log comes again.
    fn want_everything(&mut self) {
        self.forget_wishes();
        self.seat.next_operation = OperationId(0);
        self.seat.topology_version = 0;
        self.seat.topology_hash = TopologyHash(0);
    }

    /// Takes the seat again; `None` when that failed for good, and the inbox knows, or nobody wants it.
    async fn come_back(&mut self, why: String, is_lost: bool) -> Option<ClientHandle> {
        tracing::info!(why, is_lost, "the connection is made anew");
        let began = Instant::now();
        let give_up = began + self.patience;
        let (mut wait, mut last) = (WAIT_FIRST, None);
        if is_lost {
            self.lose(&why);
        } else {
            wait = Duration::ZERO;
        }
        loop {
            let next = (Instant::now() + wait).min(give_up);
            if while_away(
                &mut self.commands,
                &self.condition,
                tokio::time::sleep_until(next),
            )
            .await
            .is_none()
            {
                self.inbox.push(ClientEvent::Closed(CloseReason::Left));
                return None;
            }
            if wait > Duration::ZERO && Instant::now() >= give_up {
                let tried = self.patience.as_secs_f64();
                let last = last.map_or(String::new(), |l| format!(": {l}"));
                self.close(format!(
                    "{why}; it could not be reached again within {tried} s{last}"
                ));
                return None;
            }
            let hello = Hello {
                resume: Some(self.seat),
                ..self.hello.clone()
            };
            let attempt = tokio::time::timeout(
                ATTEMPT_MAX,
                join(self.link, hello, Some(self.delay.clone())),
            );
            match while_away(&mut self.commands, &self.condition, attempt).await {
                None => {
                    self.inbox.push(ClientEvent::Closed(CloseReason::Left));
                    return None;
                }
                Some(Ok(Ok((handle, welcome)))) => {
                    self.welcome_back(welcome);
                    self.ask_again(&handle, began.elapsed());
                    return Some(handle);
                }
                Some(Ok(Err(ClientError::Refused(sentence)))) => {
                    self.close(sentence);
                    return None;
                }
                Some(Ok(Err(ClientError::Transport(
                    error @ TransportError::WrongCertificate { .. },
                )))) => {
                    // No repetition makes another host the one of the link.
                    self.close(error.to_string());
                    return None;
                }
                Some(Ok(Err(error))) => last = Some(error.to_string()),
                Some(Err(_)) => last = Some("no answer".to_owned()),
            }
            // What was to be made anew now is lost.
            self.lose(&why);
            wait = (2 * wait).clamp(WAIT_FIRST, WAIT_MAX);
        }
    }

    fn lose(&mut self, why: &str) {
        if !std::mem::replace(&mut self.is_lost, true) {
            self.inbox.push(ClientEvent::LinkLost);
        }
        self.condition
            .send_modify(|c| c.lost = Some(why.to_owned()));
    }

    /// Asks again for what was not answered, or says that it is lost.
    fn ask_again(&mut self, handle: &ClientHandle, away: Duration) {
        if away > REPEAT_WITHIN {
            let lost = self.requests.give_up();
            self.condition.send_modify(|c| c.requests_lost += lost);
            return;
        }
        for request in self.requests.unanswered() {
            // The commands of a new session have room for more than are kept.
            let _ = handle.commands.try_send(ClientCommand::Numbered(request));
        }
    }

    fn welcome_back(&mut self, welcome: Box<Welcome>) {
        if welcome.first_operation == OperationId(0) {
            self.forget_wishes();
            self.delay = DelaySchedule::new(&welcome.compensation);
        }
        self.seat = Resume::after_welcome(&welcome, Some(self.seat));
        self.inbox.push(ClientEvent::Welcomed(welcome));
        if std::mem::take(&mut self.is_lost) {
            self.inbox.push(ClientEvent::LinkRestored);
        }
        self.condition.send_modify(|c| {
            c.returns += u64::from(c.lost.take().is_some());
        });
    }

    /// The last event always finds room.
    fn close(&self, why: String) {
        let reason = CloseReason::ConnectionLost(why);
        self.inbox.push(ClientEvent::Closed(reason));
    }
}

/// Does something while there is no connection: motion is dropped, requests that a person made are counted. `None` when the
/// participant leaves meanwhile.
async fn while_away<T>(
    commands: &mut mpsc::Receiver<ClientCommand>,
    condition: &watch::Sender<Condition>,
    work: impl Future<Output = T>,
) -> Option<T> {
    tokio::pin!(work);
    loop {
        tokio::select! {
            done = &mut work => return Some(done),
            command = commands.recv() => match command {
                None | Some(ClientCommand::Leave) => return None,
                Some(ClientCommand::Request(kind)) if is_felt(&kind) => {
                    condition.send_modify(|c| c.requests_lost += 1);
                }
                Some(_) => {}
            },
        }
    }
}

/// Dropping the commands leaves the session, if it still stands.
async fn end(mut handle: ClientHandle) {
    drop(handle.commands);
    handle.events.close();
    if handle.task.await.is_err() {
        tracing::error!("the task of the session ended by a panic");
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::handshake::Subscription;
    use palpate_protocol::operation::{CompensationMode, CompensationSettings};
    use palpate_protocol::request::{CutRequest, RequestKind};
    use palpate_protocol::{CertificateHash, Grant, ParticipantId, ResumeToken, Role};

    use super::*;

    fn cut() -> ClientCommand {
        ClientCommand::Request(RequestKind::Cut(CutRequest {
            points: Vec::new(),
            width_m: 0.0,
        }))
    }

    /// A lifeline, told nothing yet, and the end for reasons.
    fn lifeline<'a>(link: &'a JoinLink, inbox: &'a Inbox) -> (Lifeline<'a>, mpsc::Sender<String>) {
        let (rejoin, reasons) = mpsc::channel(1);
        let hello = Hello {
            name: "ann".to_owned(),
            role: Role::Trainee,
            grant: link.grant,
            tool: None,
            subscription: Subscription::Full,
            resume: None,
        };
        let seat = Resume {
            participant: ParticipantId(1),
            token: ResumeToken([0; 16]),
            next_operation: OperationId(5),
            topology_version: 1,
            topology_hash: TopologyHash(1),
        };
        let lifeline = Lifeline {
            link,
            hello,
            seat,
            patience: Duration::ZERO,
            inbox,
            commands: mpsc::channel(1).1,
            rejoin: reasons,
            requests: Requests::new(ParticipantId(1)),
            delay: DelaySchedule::new(&CompensationSettings {
                mode: CompensationMode::Fixed,
                initial_delay_us: 0,
            }),
            stats: watch::channel(DriverStats::default()).0,
            condition: watch::channel(Condition::default()).0,
            is_lost: false,
        };
        (lifeline, rejoin)
    }

    fn link() -> JoinLink {
        JoinLink {
            host: "127.0.0.1".to_owned(),
            port: 1,
            role: Role::Trainee,
            certificate: CertificateHash([0; 32]),
            grant: Grant([0; 16]),
        }
    }

    #[tokio::test]
    async fn a_request_that_finds_no_room_is_said_to_be_lost_and_takes_no_number() {
        let (link, inbox) = (link(), Inbox::default());
        let (mut lifeline, _) = lifeline(&link, &inbox);
        let (commands, mut taken) = mpsc::channel(1);
        let handle = ClientHandle {
            commands,
            events: mpsc::channel(1).1,
            stats: watch::channel(DriverStats::default()).1,
            task: tokio::spawn(async {}),
        };
        let mut number = || match taken.try_recv() {
            Ok(ClientCommand::Numbered(request)) => Some(request.id.0),
            _ => None,
        };
        lifeline.pass_on(&handle, cut());
        lifeline.pass_on(&handle, cut());
        assert_eq!(lifeline.condition.borrow().requests_lost, 1);
        assert_eq!(number(), Some(1));
        lifeline.pass_on(&handle, cut());
        assert_eq!(number(), Some(2), "no number is jumped over");
        drop(taken);
        lifeline.pass_on(&handle, cut());
        let open: Vec<u32> = lifeline
            .requests
            .unanswered()
            .iter()
            .map(|r| r.id.0)
            .collect();
        assert_eq!(open, [1, 2, 3], "a connection that is over is waited out");
    }

    #[test]
    fn a_reason_that_waits_while_everything_comes_anyway_is_forgotten() {
        let (link, inbox) = (link(), Inbox::default());
        let (mut lifeline, rejoin) = lifeline(&link, &inbox);
        rejoin.try_send("it drifts".to_owned()).unwrap();
        lifeline.want_everything();
        assert!(lifeline.rejoin.try_recv().is_err());
        assert_eq!(lifeline.seat.next_operation, OperationId(0));
    }
}
