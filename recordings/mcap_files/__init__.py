"""The MCAP container: records, chunks, the summary, recovery where a file is damaged, folders of files."""
