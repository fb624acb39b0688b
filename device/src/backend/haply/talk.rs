//! The conversation of states and forces, on a thread of its own.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::alarms::{Alarms, Watch};
use super::inventory;
use super::link::{Link, Received};
use super::message::{Message, Spelling, force};
use crate::DeviceFault;
use crate::backend::exchange::{DriverEnd, News, Order};

/// How long the loop's next force is waited for.
const IDLE: Duration = Duration::from_millis(2);

/// How long an answer is waited for. Whatever force was asked for, zero is sent then, without an answer.
const ANSWER: Duration = Duration::from_millis(50);

/// Answers that may be owed before the service counts as gone: half a second of them.
const OWED_MAX: u32 = 10;

/// How long to wait before a service that went away is looked for again.
const AGAIN: Duration = Duration::from_secs(1);

/// The conversation.
pub(super) struct Talk {
    pub(super) url: String,
    pub(super) id: String,
    pub(super) spelling: Spelling,
    pub(super) end: DriverEnd,
    pub(super) news: News,
    pub(super) alarms: Arc<Alarms>,
    pub(super) leave: Arc<AtomicBool>,
}

/// Why the conversation ended.
struct Over;

impl Talk {
    /// Holds it until it is told to leave, and begins it again when it breaks. It ends with a force of zero.
    pub(super) fn hold(mut self, link: Link) {
        let mut watch = Watch::default();
        let mut next = Some(link);
        while let Some(mut link) = next.take() {
            link.wait_at_most(ANSWER);
            let ended = self.exchanges(&mut link, &mut watch);
            // Also after a break: whoever is silent may still listen.
            let _ = self.send(&mut link, &Order::OFF);
            if ended.is_ok() {
                link.receive();
                link.close();
                return;
            }
            link.close();
            self.end.cut();
            self.end.tell(News {
                lost: Some(DeviceFault::Unplugged),
                ..self.news
            });
            next = self.begin_again();
            // What the loop wrote before it had heard of the loss is not meant for the new conversation.
            self.end.cut();
        }
    }

    /// Exchanges messages until it is told to leave.
    fn exchanges(&mut self, link: &mut Link, watch: &mut Watch) -> Result<(), Over> {
        while !self.leave.load(Ordering::Acquire) {
            // Whoever writes or leaves ends the wait.
            std::thread::park_timeout(IDLE);
            let order = self.end.order();
            self.exchange(link, &order, watch)?;
        }
        Ok(())
    }

    /// Another conversation, as soon as the service knows the device again; `None` when it is told to leave.
    fn begin_again(&mut self) -> Option<Link> {
        while !self.leave.load(Ordering::Acquire) {
            if let Ok((link, message)) = inventory(&self.url)
                && message.found().iter().any(|f| f.id == self.id)
            {
                self.spelling = message.spelling();
                self.alarms.is_back();
                return Some(link);
            }
            // Orders go on, and nobody takes them: the loop nudges this thread with each.
            for _ in 0..AGAIN.as_millis() {
                std::thread::park_timeout(Duration::from_millis(1));
                if self.leave.load(Ordering::Acquire) {
                    return None;
                }
            }
        }
        None
    }

    /// Sends an order and waits for its answer, and for those that are owed from before.
    fn exchange(&mut self, link: &mut Link, order: &Order, watch: &mut Watch) -> Result<(), Over> {
        self.send(link, order)?;
        let mut owed = 1;
        while owed > 0 {
            match link.receive() {
                Received::Text(text) => {
                    owed -= 1;
                    self.hear(&text, watch);
                }
                Received::Nothing if self.leave.load(Ordering::Acquire) => return Ok(()),
                Received::Nothing if owed < OWED_MAX => {
                    self.send(link, &Order::OFF)?;
                    self.end.cut();
                    owed += 1;
                }
                Received::Nothing | Received::Unfit(_) | Received::Closed(_) => return Err(Over),
            }
        }
        Ok(())
    }

    fn send(&self, link: &mut Link, order: &Order) -> Result<(), Over> {
        let text = force(&self.id, self.spelling, order.wrench.force);
        link.send(text).map_err(|_| Over)
    }

    /// Hands over what an answer says. One that can not be read is none: news that stay out are noticed by the loop.
    fn hear(&mut self, text: &str, watch: &mut Watch) {
        let Ok(message) = Message::read(text) else {
            return;
        };
        let Some(mut news) = message.news(&self.id, &self.news) else {
            return;
        };
        news.faults = watch.look(&self.alarms);
        if self.alarms.is_gone() {
            news.lost = Some(DeviceFault::Unplugged);
        }
        self.news = news;
        self.end.tell(news);
    }
}
