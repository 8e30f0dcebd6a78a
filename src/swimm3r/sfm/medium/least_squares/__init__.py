"""The least squares behind Sea-Thru: one channel under the sun, all channels under a lamp."""
