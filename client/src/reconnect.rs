//! The connection of a session: serves it while it lasts, and reconnects when it is lost.

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

/// Time after the session's `LinkLost` before the client reconnects. The server has then also dropped the connection.
const SILENCE_MAX: Duration = Duration::from_secs(1);

/// Delay before the first attempt to reconnect; doubled for every further one.
const WAIT_FIRST: Duration = Duration::from_millis(250);

/// Maximum delay between two attempts.
const WAIT_MAX: Duration = Duration::from_secs(8);

/// Timeout of one attempt. Handshake packets are retransmitted after 0.3, 0.6 and 1.2 s; beyond that a new handshake
/// succeeds sooner.
const ATTEMPT_MAX: Duration = Duration::from_secs(4);

/// Maximum age of requests that are sent again. Older ones are dropped, because hand and tissue have moved on.
const REPEAT_WITHIN: Duration = Duration::from_secs(10);

/// State of the connection, for the status line.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Condition {
    /// Cause while the connection is lost.
    pub(crate) lost: Option<String>,
    /// Number of reconnects.
    pub(crate) returns: u64,
    /// Requests that were dropped without a connection, or not answered in time.
    pub(crate) requests_lost: u64,
}

/// State to reconnect a session, and the channel ends that outlive a connection.
pub(crate) struct Reconnect<'a> {
    pub(crate) link: &'a JoinLink,
    pub(crate) hello: Hello,
    pub(crate) seat: Resume,
    /// How long to try.
    pub(crate) patience: Duration,
    pub(crate) inbox: &'a Inbox,
    pub(crate) commands: mpsc::Receiver<ClientCommand>,
    /// Receives the reason when the site needs a resync from the whole log.
    pub(crate) rejoin: mpsc::Receiver<String>,
    pub(crate) requests: Requests,
    /// The artificial delay, from the log.
    pub(crate) delay: DelaySchedule,
    pub(crate) stats: watch::Sender<DriverStats>,
    pub(crate) condition: watch::Sender<Condition>,
    pub(crate) is_lost: bool,
}

/// Whether a later run can resume the seat of a session that is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Farewell {
    /// The server has released the seat.
    Final,
    /// The server may still hold the seat: it was not reached again.
    Open,
}

/// Why serving a connection stopped.
enum Over {
    /// The session is over; the inbox has the event.
    Ended,
    /// The participant leaves.
    Leaving,
    /// The connection is lost.
    Lost(String),
    /// The replica needs a resync.
    Resync(String),
}

impl Reconnect<'_> {
    /// Serves the session until it is over.
    pub(crate) async fn run(mut self, mut handle: ClientHandle) -> Farewell {
        loop {
            let (why, is_lost) = match self.pump(&mut handle).await {
                Over::Ended | Over::Leaving => {
                    end(handle).await;
                    return Farewell::Final;
                }
                Over::Lost(why) => (why, true),
                Over::Resync(why) => (why, false),
            };
            // A goodbye would release the seat.
            handle.task.abort();
            match self.reconnect(why, is_lost).await {
                Some(again) => handle = again,
                None => return Farewell::Open,
            }
        }
    }

    /// Discards queued resync reasons when a resync is about to start anyway.
    fn discard_reasons(&mut self) {
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
                    self.request_whole_log();
                    return Over::Resync(why);
                }
                Ok(()) = handle.stats.changed() => {
                    self.stats.send_replace(*handle.stats.borrow_and_update());
                }
                () = silence => {
                    return Over::Lost("no packet from the server for 2 s".to_owned());
                }
            }
        }
    }

    /// Records an event and queues it in the inbox.
    fn take(&mut self, event: Option<ClientEvent>) -> Option<Over> {
        let lost = |reason: &CloseReason| {
            matches!(
                reason,
                CloseReason::ConnectionLost(_) | CloseReason::Silent(_)
            )
        };
        let event = match event {
            None => return Some(Over::Lost("the session ended without a reason".to_owned())),
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
            self.close("the inbox is full: this machine applies operations too slowly".to_owned());
            return Some(Over::Ended);
        }
        is_last.then_some(Over::Ended)
    }

    /// Records the operation from which the next connection resumes.
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
                // This connection is over; the request is repeated on the next one.
                self.requests.number(kind);
            }
            (ClientCommand::Request(kind), Err(mpsc::error::TrySendError::Full(()))) => {
                // A skipped number would count as done once a later one arrives.
                if is_felt(&kind) {
                    tracing::warn!("the command queue of the session is full");
                    self.condition.send_modify(|c| c.requests_lost += 1);
                }
            }
            (command, Ok(room)) => room.send(command),
            // Late motion is worthless.
            (_, Err(_)) => {}
        }
    }

    /// Resumes the seat without any operation, so that the server sends the whole log.
    fn request_whole_log(&mut self) {
        self.discard_reasons();
        self.seat.next_operation = OperationId(0);
        self.seat.topology_version = 0;
        self.seat.topology_hash = TopologyHash(0);
    }

    /// Reconnects and resumes the seat. `None` when the attempt failed for good (the inbox has the event) or the
    /// participant leaves.
    async fn reconnect(&mut self, why: String, is_lost: bool) -> Option<ClientHandle> {
        tracing::info!(why, is_lost, "reconnecting");
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
                self.close(format!("{why}; reconnecting failed for {tried} s{last}"));
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
                    // Retrying can not fix a wrong certificate.
                    self.close(error.to_string());
                    return None;
                }
                Some(Ok(Err(error))) => last = Some(error.to_string()),
                Some(Err(_)) => last = Some("no answer".to_owned()),
            }
            // During a resync the connection was not lost before; now it is.
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

    /// Repeats unanswered requests, or counts them as lost.
    fn ask_again(&mut self, handle: &ClientHandle, away: Duration) {
        if away > REPEAT_WITHIN {
            let lost = self.requests.give_up();
            self.condition.send_modify(|c| c.requests_lost += lost);
            return;
        }
        for request in self.requests.unanswered() {
            // A new session's command queue has room for all of them.
            let _ = handle.commands.try_send(ClientCommand::Numbered(request));
        }
    }

    fn welcome_back(&mut self, welcome: Box<Welcome>) {
        if welcome.first_operation == OperationId(0) {
            self.discard_reasons();
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

    /// The inbox always accepts the last event.
    fn close(&self, why: String) {
        let reason = CloseReason::ConnectionLost(why);
        self.inbox.push(ClientEvent::Closed(reason));
    }
}

/// Runs `work` without a connection: motion is dropped and the participant's requests are counted as lost. `None`
/// when the participant leaves meanwhile.
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

/// Dropping the commands leaves the session, if it is still connected.
async fn end(mut handle: ClientHandle) {
    drop(handle.commands);
    handle.events.close();
    if handle.task.await.is_err() {
        tracing::error!("the session task panicked");
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

    /// A fresh reconnecter and the sender of resync reasons.
    fn reconnect<'a>(
        link: &'a JoinLink,
        inbox: &'a Inbox,
    ) -> (Reconnect<'a>, mpsc::Sender<String>) {
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
        let reconnect = Reconnect {
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
        (reconnect, rejoin)
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
    async fn rejected_request_is_counted_and_takes_no_number() {
        let (link, inbox) = (link(), Inbox::default());
        let (mut reconnect, _) = reconnect(&link, &inbox);
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
        reconnect.pass_on(&handle, cut());
        reconnect.pass_on(&handle, cut());
        assert_eq!(reconnect.condition.borrow().requests_lost, 1);
        assert_eq!(number(), Some(1));
        reconnect.pass_on(&handle, cut());
        assert_eq!(number(), Some(2), "no number is skipped");
        drop(taken);
        reconnect.pass_on(&handle, cut());
        let open: Vec<u32> = reconnect
            .requests
            .unanswered()
            .iter()
            .map(|r| r.id.0)
            .collect();
        assert_eq!(open, [1, 2, 3], "requests outlive their connection");
    }

    #[test]
    fn queued_resync_reason_is_discarded_by_resync() {
        let (link, inbox) = (link(), Inbox::default());
        let (mut reconnect, rejoin) = reconnect(&link, &inbox);
        rejoin.try_send("it drifts".to_owned()).unwrap();
        reconnect.request_whole_log();
        assert!(reconnect.rejoin.try_recv().is_err());
        assert_eq!(reconnect.seat.next_operation, OperationId(0));
    }
}
