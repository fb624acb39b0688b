//! Where the page of a session is served: its address, its host name and its certificate.

use std::net::SocketAddr;

use palpate_transport::PageTls;

use super::links::public_host;
use super::options::HostOptions;
use crate::ServerError;

/// Address and certificate of a page.
pub(super) struct PageSite {
    pub(super) listen: SocketAddr,
    /// `None` for plain HTTP.
    pub(super) tls: Option<PageTls>,
    /// The names in self-signed certificates.
    pub(super) names: Vec<String>,
    /// Host name or address for URLs.
    pub(super) host: String,
    /// Public name of the host, which browsers may use beside addresses and `localhost`.
    pub(super) public: Option<String>,
}

impl PageSite {
    /// The page that the options ask for; `None` without one. Fails if its certificate can not be used.
    pub(super) fn of(options: &HostOptions) -> Result<Option<Self>, ServerError> {
        let Some(listen) = options.view else {
            return Ok(None);
        };
        // A name of the operator leads to this machine, but not to its loopback address.
        let host = match &options.public {
            Some(public) if !listen.ip().is_loopback() => public.clone(),
            _ if listen.ip().is_unspecified() => public_host(None, listen),
            _ => listen.ip().to_string(),
        };
        let names = names(&host, listen);
        let tls = match (&options.certificate, &options.key) {
            (Some(certificate), Some(key)) => Some(PageTls::from_files(certificate, key)?),
            _ if listen.ip().is_loopback() => None,
            _ => Some(PageTls::self_signed(names.clone())?),
        };
        Ok(Some(Self {
            listen,
            tls,
            names,
            host,
            public: options.public.clone(),
        }))
    }

    /// Whether browsers will warn about its certificate.
    pub(super) fn is_self_signed(&self) -> bool {
        self.tls.as_ref().is_some_and(PageTls::is_self_signed)
    }
}

/// The names in a self-signed certificate: those by which the page can be reached.
fn names(host: &str, listen: SocketAddr) -> Vec<String> {
    let mut names = vec![host.to_owned(), "localhost".to_owned()];
    if !listen.ip().is_unspecified() {
        names.push(listen.ip().to_string());
    }
    names.dedup();
    names
}
