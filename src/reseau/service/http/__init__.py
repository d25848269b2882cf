"""The service over HTTP: one API, events, and the pages that use it; `reseau serve`."""
